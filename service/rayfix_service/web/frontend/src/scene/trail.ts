/** A thin line through the latest positions of something that moves. */

import { BufferAttribute, BufferGeometry, DynamicDrawUsage, Line, LineBasicMaterial, type Vector3 } from "three";

export class Trail extends Line<BufferGeometry, LineBasicMaterial> {
  constructor(private readonly most: number) {
    const positions = new BufferAttribute(new Float32Array(3 * most), 3).setUsage(DynamicDrawUsage);
    super(
      new BufferGeometry().setAttribute("position", positions),
      new LineBasicMaterial({ transparent: true, depthWrite: false }),
    );
    this.frustumCulled = false;
    this.renderOrder = 3;
    this.visible = false;
  }

  /** Draw it through these positions, the latest last; nothing for fewer than two. */
  draw(points: readonly Vector3[], colour: number, opacity: number): void {
    const latest = points.slice(-this.most);
    this.visible = latest.length > 1;
    if (!this.visible) return;
    const positions = this.geometry.getAttribute("position") as BufferAttribute;
    latest.forEach((p, n) => positions.setXYZ(n, p.x, p.y, p.z));
    positions.needsUpdate = true;
    this.geometry.setDrawRange(0, latest.length);
    this.material.color.set(colour);
    this.material.opacity = opacity;
  }

  override dispose(): void {
    this.geometry.dispose();
    this.material.dispose();
  }
}
