/** What the drawings of fixes, paths and mixtures are made of: dots, ellipsoids, lines. */

import {
  BufferAttribute,
  BufferGeometry,
  Color,
  DynamicDrawUsage,
  Group,
  Matrix4,
  Mesh,
  Points,
  ShaderMaterial,
  SphereGeometry,
  Vector3,
} from "three";
import { Line2 } from "three/addons/lines/Line2.js";
import { LineGeometry } from "three/addons/lines/LineGeometry.js";
import { LineMaterial } from "three/addons/lines/LineMaterial.js";

import { eigen } from "../numeric";
import type { Matrix3 } from "../types";

const SPHERE = new SphereGeometry(1, 40, 24);

const RIM_VERTEX = /* glsl */ `
  varying vec3 vNormal;
  varying vec3 vToEye;
  void main() {
    vec4 seen = modelViewMatrix * vec4(position, 1.0);
    vNormal = normalMatrix * normal;
    vToEye = isOrthographic ? vec3(0.0, 0.0, 1.0) : -seen.xyz;
    gl_Position = projectionMatrix * seen;
  }`;

const RIM_FRAGMENT = /* glsl */ `
  uniform vec3 colour;
  uniform float opacity;
  varying vec3 vNormal;
  varying vec3 vToEye;
  void main() {
    float facing = abs(dot(normalize(vNormal), normalize(vToEye)));
    float rim = pow(1.0 - facing, 1.6);
    gl_FragColor = vec4(colour, opacity * (0.3 + 0.7 * rim));
    #include <colorspace_fragment>
  }`;

/** An ellipsoid whose rim is denser than its middle, as a thin shell's would be. */
class Ellipsoid extends Mesh<SphereGeometry, ShaderMaterial> {
  constructor() {
    super(
      SPHERE,
      new ShaderMaterial({
        uniforms: { colour: { value: new Color() }, opacity: { value: 1 } },
        vertexShader: RIM_VERTEX,
        fragmentShader: RIM_FRAGMENT,
        transparent: true,
        depthWrite: false,
      }),
    );
    this.matrixAutoUpdate = false;
    this.renderOrder = 5;
  }

  /** Put it where a Gaussian is; its surface is `sigmas` standard deviations from the mean, and `least` m at least. */
  place(mean: Vector3, covariance: Matrix3, sigmas: number, least = 0.02): void {
    const { values, vectors } = eigen(covariance);
    const [a, b, c] = vectors.map((v, n) =>
      new Vector3(...v).multiplyScalar(Math.max(sigmas * Math.sqrt(values[n]!), least)),
    ) as [Vector3, Vector3, Vector3];
    this.matrix.copy(new Matrix4().makeBasis(a, b, c)).setPosition(mean);
    this.matrixWorldNeedsUpdate = true;
  }

  paint(colour: number, opacity: number): void {
    (this.material.uniforms["colour"]!.value as Color).set(colour);
    this.material.uniforms["opacity"]!.value = opacity;
  }
}

const DOT_VERTEX = /* glsl */ `
  attribute vec3 colour;
  attribute float diameter;
  uniform float ratio;
  varying vec3 vColour;
  void main() {
    vColour = colour;
    gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
    gl_PointSize = diameter * ratio;
  }`;

const DOT_FRAGMENT = /* glsl */ `
  uniform float opacity;
  uniform vec3 rim;
  uniform float rimShare;
  varying vec3 vColour;
  void main() {
    float r = 2.0 * length(gl_PointCoord - 0.5);
    if (r > 1.0) discard;
    vec3 mixed = r > 1.0 - rimShare ? rim : vColour;
    gl_FragColor = vec4(mixed, opacity * smoothstep(1.0, 0.88, r));
    #include <colorspace_fragment>
  }`;

export interface Dot {
  position: Vector3;
  colour: number;
  /** px */
  diameter: number;
}

/** Round dots of a fixed size on the screen. */
export class Dots extends Points<BufferGeometry, ShaderMaterial> {
  private capacity = 0;

  constructor(options: { opacity?: number; rim?: number; throughWalls?: boolean } = {}) {
    super(
      new BufferGeometry(),
      new ShaderMaterial({
        uniforms: {
          ratio: { value: 1 },
          opacity: { value: options.opacity ?? 1 },
          rim: { value: new Color(0xffffff) },
          rimShare: { value: options.rim ?? 0 },
        },
        vertexShader: DOT_VERTEX,
        fragmentShader: DOT_FRAGMENT,
        transparent: true,
        depthWrite: false,
        depthTest: !options.throughWalls,
      }),
    );
    this.frustumCulled = false;
    this.renderOrder = options.throughWalls ? 9 : 6;
    this.onBeforeRender = (renderer): void => {
      this.material.uniforms["ratio"]!.value = renderer.getPixelRatio();
    };
  }

  setRim(colour: number): void {
    (this.material.uniforms["rim"]!.value as Color).set(colour);
  }

  set(dots: readonly Dot[]): void {
    if (dots.length > this.capacity) {
      this.capacity = Math.max(16, 2 * dots.length);
      this.geometry.dispose();
      this.geometry = new BufferGeometry();
      for (const [name, size] of [
        ["position", 3],
        ["colour", 3],
        ["diameter", 1],
      ] as const) {
        const attribute = new BufferAttribute(new Float32Array(size * this.capacity), size);
        this.geometry.setAttribute(name, attribute.setUsage(DynamicDrawUsage));
      }
    }
    this.visible = dots.length > 0;
    if (!this.visible) return;
    const { position, colour, diameter } = this.geometry.attributes as Record<string, BufferAttribute>;
    const shade = new Color();
    dots.forEach((dot, n) => {
      shade.set(dot.colour);
      position!.setXYZ(n, dot.position.x, dot.position.y, dot.position.z);
      colour!.setXYZ(n, shade.r, shade.g, shade.b);
      diameter!.setX(n, dot.diameter);
    });
    for (const attribute of [position!, colour!, diameter!]) attribute.needsUpdate = true;
    this.geometry.setDrawRange(0, dots.length);
  }
}

export interface FatLine {
  points: readonly Vector3[];
  colour: number;
  /** px */
  width: number;
  opacity: number;
  /** Whether it shows through what is before it. */
  throughWalls: boolean;
}

/**
 * Lines some pixels wide. They are kept from one drawing to the next: with the last material of its kind, three.js drops
 * the compiled shader, and compiling is what takes long.
 */
export class FatLines extends Group {
  private readonly lines: Line2[] = [];

  set(wanted: readonly FatLine[]): void {
    wanted.forEach(({ points, colour, width, opacity, throughWalls }, n) => {
      const line = this.lines[n] ?? this.append();
      line.visible = true;
      line.geometry.dispose();
      line.geometry = new LineGeometry().setPositions(points.flatMap((p) => [p.x, p.y, p.z]));
      line.material.color.set(colour);
      line.material.linewidth = width;
      line.material.opacity = opacity;
      line.material.depthTest = !throughWalls;
      line.renderOrder = throughWalls ? 3 : 4;
    });
    for (let n = wanted.length; n < this.lines.length; n++) this.lines[n]!.visible = false;
  }

  private append(): Line2 {
    const line = new Line2(new LineGeometry(), new LineMaterial({ transparent: true, depthWrite: false }));
    this.lines.push(line);
    this.add(line);
    return line;
  }
}

export interface Shell {
  mean: Vector3;
  covariance: Matrix3;
  sigmas: number;
  colour: number;
  opacity: number;
  throughWalls: boolean;
}

/** Ellipsoids, kept from one drawing to the next for the same reason as lines. */
export class Ellipsoids extends Group {
  private readonly shells: Ellipsoid[] = [];

  set(wanted: readonly Shell[]): void {
    wanted.forEach((shell, n) => {
      const ellipsoid = this.shells[n] ?? this.append();
      ellipsoid.visible = true;
      ellipsoid.place(shell.mean, shell.covariance, shell.sigmas);
      ellipsoid.paint(shell.colour, shell.opacity);
      ellipsoid.material.depthTest = !shell.throughWalls;
    });
    for (let n = wanted.length; n < this.shells.length; n++) this.shells[n]!.visible = false;
  }

  private append(): Ellipsoid {
    const ellipsoid = new Ellipsoid();
    this.shells.push(ellipsoid);
    this.add(ellipsoid);
    return ellipsoid;
  }
}
