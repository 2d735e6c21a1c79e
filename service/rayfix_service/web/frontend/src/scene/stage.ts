/** The canvas: camera, controls, light, and a loop that draws only what has changed. */

import {
  Box3,
  Color,
  DirectionalLight,
  Group,
  HemisphereLight,
  OrthographicCamera,
  PerspectiveCamera,
  Plane,
  Raycaster,
  Scene,
  Vector2,
  Vector3,
  WebGLRenderer,
} from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

import { theme } from "../theme";
import type { Vec3 } from "../types";
import { Labels } from "./labels";

export type ViewName = "orbit" | "plan" | "side";

const SLOW_FRAME = 55; // ms; beyond, the picture gets coarser while it moves
const SLOW_RUN = 6; // frames in a row; the first ones of a drawing are slow by nature
const COARSEST = 0.6;
const SETTLED = 250; // ms after the last change, it is drawn finely again
const KEPT_FRAMES = 600;
const LEAST_PAUSE = 50; // ms between pictures of what a stream brings
const MOST_PAUSE = 500;
const FOCUS = 0.42; // of the building's extent, when one place is looked at

/** Constant of a section that cuts nothing; an infinite one would be no number on the graphics card. */
export const UNCUT = 1e6;

export class Stage {
  readonly renderer: WebGLRenderer;
  readonly scene = new Scene();
  /** Everything that is drawn; its frame is the scene frame less `origin`. */
  readonly world = new Group();
  readonly labels: Labels;
  readonly controls: OrbitControls;
  readonly section = new Plane(new Vector3(-1, 0, 0), UNCUT);
  /** Milliseconds from frame to frame, where one followed the other; the latest last. */
  readonly frameTimes: number[] = [];
  camera: PerspectiveCamera | OrthographicCamera;
  view: ViewName = "orbit";
  origin: Vec3 = [0, 0, 0];
  bounds = new Box3(new Vector3(-1, -1, -1), new Vector3(1, 1, 1));
  private readonly perspective = new PerspectiveCamera(38, 1, 0.05, 1000);
  private readonly orthographic = new OrthographicCamera(-1, 1, 1, -1, 0.05, 1000);
  private readonly sky = new HemisphereLight();
  private readonly sun = new DirectionalLight();
  private readonly beforeFrame: (() => void)[] = [];
  private size = { width: 1, height: 1 };
  private insets = { left: 0, right: 0, top: 0, bottom: 0 };
  private dirty = true;
  private running = false;
  private lastFrame = 0;
  private slow = 0;
  private later = 0;
  private lastDuration = 0;
  private untouched = true;
  private coarseness = 1;
  private settle = 0;

  constructor(
    private readonly canvas: HTMLCanvasElement,
    labelLayer: HTMLElement,
  ) {
    this.renderer = new WebGLRenderer({ canvas, antialias: true, powerPreference: "high-performance" });
    this.renderer.localClippingEnabled = true;
    this.labels = new Labels(labelLayer);
    this.scene.add(this.world, this.sky, this.sun);
    this.camera = this.perspective;
    for (const camera of [this.perspective, this.orthographic]) camera.up.set(0, 0, 1);
    this.perspective.position.set(1, -1, 1);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.enableDamping = true;
    this.controls.dampingFactor = 0.15;
    this.controls.zoomToCursor = true;
    this.controls.listenToKeyEvents(canvas);
    this.controls.maxPolarAngle = Math.PI * 0.98;
    this.controls.addEventListener("change", () => this.invalidate());
    this.controls.addEventListener("start", () => (this.untouched = false));
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement!);
    theme.onChange(() => this.paint());
    this.paint();
    this.resize();
  }

  /** Of the canvas, px. */
  get extent(): { width: number; height: number } {
    return this.size;
  }

  /** A place of the scene frame in the world's. */
  local(p: Vec3): Vector3 {
    return new Vector3(p[0] - this.origin[0], p[1] - this.origin[1], p[2] - this.origin[2]);
  }

  /** What is to be done before each frame. */
  onFrame(task: () => void): void {
    this.beforeFrame.push(task);
  }

  /** Space that panels take from the edges of the canvas, px. */
  setInsets(insets: { left: number; right: number; top: number; bottom: number }): void {
    this.insets = insets;
    this.resize();
    // Who has moved the camera keeps it where it is.
    if (this.untouched) this.show(this.view);
  }

  /**
   * Draw again soon. What a stream brings is drawn less often than what a person does, and never more than half of the
   * time: however slow drawing is, the page goes on answering.
   */
  invalidateLater(): void {
    if (this.later) return;
    const pause = Math.min(Math.max(this.lastDuration, LEAST_PAUSE), MOST_PAUSE);
    this.later = window.setTimeout(() => this.invalidate(), pause);
  }

  invalidate(): void {
    window.clearTimeout(this.later);
    this.later = 0;
    this.dirty = true;
    if (this.running) return;
    this.running = true;
    this.lastFrame = 0;
    requestAnimationFrame(this.frame);
  }

  private readonly frame = (now: number): void => {
    if (this.lastFrame > 0) this.measure(now - this.lastFrame);
    this.lastFrame = now;
    const moving = this.controls.update();
    if (!this.dirty && !moving) {
      this.running = false;
      return;
    }
    this.dirty = false;
    this.draw();
    window.clearTimeout(this.settle);
    if (this.coarseness < 1) this.settle = window.setTimeout(() => this.coarsen(1), SETTLED);
    requestAnimationFrame(this.frame);
  };

  private draw(): void {
    for (const task of this.beforeFrame) task();
    this.renderer.render(this.scene, this.camera);
    const { width, height } = this.size;
    this.labels.place(this.camera, width, height, width - this.insets.right);
  }

  private measure(duration: number): void {
    this.lastDuration = duration;
    this.frameTimes.push(duration);
    if (this.frameTimes.length > KEPT_FRAMES) this.frameTimes.shift();
    this.slow = duration > SLOW_FRAME ? this.slow + 1 : 0;
    if (this.slow > SLOW_RUN && this.coarseness > COARSEST) {
      this.coarsen(Math.max(COARSEST, this.coarseness * 0.8));
      this.slow = 0;
    }
  }

  private coarsen(factor: number): void {
    this.coarseness = factor;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2) * factor);
    this.invalidate();
  }

  private paint(): void {
    const { palette } = theme;
    this.scene.background = new Color(palette.background);
    this.sky.color.set(palette.light.sky);
    this.sky.groundColor.set(palette.light.ground);
    this.sky.position.set(0, 0, 1);
    this.sky.intensity = palette.light.ambient;
    this.sun.intensity = palette.light.sun;
    this.sun.position.set(0.5, -0.8, 1.3);
    this.invalidate();
  }

  private resize(): void {
    const { clientWidth, clientHeight } = this.canvas.parentElement!;
    this.size = { width: Math.max(1, clientWidth), height: Math.max(1, clientHeight) };
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2) * this.coarseness);
    this.renderer.setSize(this.size.width, this.size.height);
    this.project();
  }

  /** Set the cameras up so that the middle of the free space between the panels is the middle of the picture. */
  private project(): void {
    const { width, height } = this.size;
    const x = (this.insets.right - this.insets.left) / 2;
    const y = (this.insets.bottom - this.insets.top) / 2;
    this.perspective.aspect = width / height;
    this.perspective.setViewOffset(width, height, x, y, width, height);
    const half = (this.orthographic.top - this.orthographic.bottom) / 2;
    this.orthographic.left = (-half * width) / height;
    this.orthographic.right = (half * width) / height;
    this.orthographic.setViewOffset(width, height, x, y, width, height);
    this.perspective.updateProjectionMatrix();
    this.orthographic.updateProjectionMatrix();
    this.invalidate();
  }

  setBounds(bounds: Box3): void {
    this.bounds = bounds;
    const reach = bounds.getSize(new Vector3()).length();
    for (const camera of [this.perspective, this.orthographic]) {
      camera.near = reach / 2000;
      camera.far = reach * 12;
    }
    this.controls.maxDistance = reach * 5;
    this.controls.minDistance = reach / 200;
  }

  /** Look at all of the building from a side, from above, or obliquely. */
  show(view: ViewName): void {
    this.view = view;
    this.untouched = true;
    const extent = this.bounds.getSize(new Vector3());
    const middle = this.bounds.getCenter(new Vector3());
    // The longer side runs to the right.
    const along = extent.y > extent.x;
    const towards = {
      orbit: along ? new Vector3(1, -0.42, 0.95) : new Vector3(-0.42, -1, 0.95),
      side: along ? new Vector3(1, 0, 0) : new Vector3(0, -1, 0),
      plan: along ? new Vector3(1e-4, 0, 1) : new Vector3(0, -1e-4, 1),
    }[view].normalize();
    const camera = view === "orbit" ? this.perspective : this.orthographic;
    this.camera = camera;
    this.controls.object = camera;
    this.controls.enableRotate = view === "orbit";
    this.controls.target.copy(middle);
    camera.position.copy(middle).addScaledVector(towards, extent.length());
    camera.lookAt(middle);
    camera.updateMatrixWorld();
    this.fit(camera, middle, towards);
    this.controls.update();
    this.invalidate();
  }

  /** Put the camera as near as the building's corners allow. */
  private fit(camera: PerspectiveCamera | OrthographicCamera, middle: Vector3, towards: Vector3): void {
    const { width, height } = this.size;
    const free = {
      x: Math.max(0.3, (width - this.insets.left - this.insets.right) / width) * 0.86,
      y: Math.max(0.3, (height - this.insets.top - this.insets.bottom) / height) * 0.86,
    };
    const right = new Vector3().setFromMatrixColumn(camera.matrixWorld, 0);
    const up = new Vector3().setFromMatrixColumn(camera.matrixWorld, 1);
    let distance = 0;
    let half = 0;
    for (let n = 0; n < 8; n++) {
      const { min, max } = this.bounds;
      const corner = new Vector3(n & 1 ? max.x : min.x, n & 2 ? max.y : min.y, n & 4 ? max.z : min.z).sub(middle);
      const [x, y, z] = [Math.abs(corner.dot(right)), Math.abs(corner.dot(up)), corner.dot(towards)];
      const tangent = Math.tan((this.perspective.fov * Math.PI) / 360);
      distance = Math.max(distance, z + x / (tangent * (width / height) * free.x), z + y / (tangent * free.y));
      half = Math.max(half, (x / free.x) * (height / width), y / free.y);
    }
    if (camera instanceof PerspectiveCamera) {
      camera.position.copy(middle).addScaledVector(towards, distance);
    } else {
      camera.zoom = 1;
      camera.top = half;
      camera.bottom = -half;
    }
    this.project();
  }

  /** Look at a place from nearby, without turning. */
  focus(place: Vector3): void {
    this.untouched = false;
    const offset = this.camera.position.clone().sub(this.controls.target);
    const near = FOCUS * this.bounds.getSize(new Vector3()).length();
    if (this.camera instanceof PerspectiveCamera) offset.setLength(Math.min(offset.length(), near));
    else this.camera.zoom = Math.max(this.camera.zoom, (2 * this.camera.top) / near);
    this.controls.target.copy(place);
    this.camera.position.copy(place).add(offset);
    this.camera.updateProjectionMatrix();
    this.controls.update();
    this.invalidate();
  }

  /** The ray under a place of the canvas, in the scene frame. */
  rayAt(x: number, y: number): { origin: Vec3; direction: Vec3 } {
    const caster = new Raycaster();
    const at = new Vector2((x / this.size.width) * 2 - 1, 1 - (y / this.size.height) * 2);
    caster.setFromCamera(at, this.camera);
    const { origin, direction } = caster.ray;
    return {
      origin: [origin.x + this.origin[0], origin.y + this.origin[1], origin.z + this.origin[2]],
      direction: [direction.x, direction.y, direction.z],
    };
  }
}
