/** Words over the drawing, as elements of the page that follow their places. */

import { Vector3, type Camera } from "three";

export interface Label {
  element: HTMLElement;
  position: Vector3;
  visible: boolean;
}

const NEAR = 200; // pixels: only there are labels measured, which takes time

export class Labels {
  private readonly labels = new Set<Label>();
  private readonly projected = new Vector3();

  constructor(private readonly layer: HTMLElement) {}

  add(text: string, className: string, position = new Vector3()): Label {
    const element = document.createElement("div");
    element.className = `label ${className}`;
    element.textContent = text;
    this.layer.append(element);
    const label = { element, position, visible: true };
    this.labels.add(label);
    return label;
  }

  remove(label: Label): void {
    label.element.remove();
    this.labels.delete(label);
  }

  /** Put the words at their places, and to the left of those that are near the end of the visible part. */
  place(camera: Camera, width: number, height: number, end: number): void {
    for (const label of this.labels) {
      const p = this.projected.copy(label.position).project(camera);
      const shown = label.visible && p.z < 1 && p.z > -1 && Math.abs(p.x) < 1.1 && Math.abs(p.y) < 1.1;
      label.element.hidden = !shown;
      if (!shown) continue;
      let x = ((p.x + 1) / 2) * width;
      if (x < end && x > end - NEAR) {
        const { offsetWidth, offsetLeft } = label.element;
        if (x + offsetLeft + offsetWidth > end) x -= offsetWidth + 2 * offsetLeft;
      }
      const y = ((1 - p.y) / 2) * height;
      label.element.style.transform = `translate(${x.toFixed(1)}px, ${y.toFixed(1)}px)`;
    }
  }
}
