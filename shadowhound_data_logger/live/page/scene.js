// The point cloud in 3D with the robot in it, and the floor plan that the lidar makes with the robot's path.
import {
  BoxGeometry, BufferAttribute, BufferGeometry, Color, ConeGeometry, GridHelper, Group, Line, LineBasicMaterial, Mesh, MeshLambertMaterial,
  AmbientLight, DirectionalLight, OrbitControls, PerspectiveCamera, Points, Scene, ShaderMaterial, Vector3, WebGLRenderer,
} from './vendor/three.js';

const VERTEX = `
uniform float size; varying float height; varying float far;
void main() {
  vec4 world = modelMatrix * vec4(position, 1.0);
  vec4 view = viewMatrix * world;
  height = world.z; far = -view.z;
  gl_Position = projectionMatrix * view;
  gl_PointSize = clamp(size / max(0.5, -view.z), 1.5, 6.0);
}`;
const FRAGMENT = `
uniform vec3 fog; varying float height; varying float far;
vec3 ramp(float t) {
  vec3 a = vec3(0.16, 0.36, 0.84), b = vec3(0.05, 0.66, 0.70), c = vec3(0.42, 0.78, 0.36), d = vec3(0.98, 0.75, 0.22);
  return t < 0.33 ? mix(a, b, t * 3.0) : t < 0.66 ? mix(b, c, (t - 0.33) * 3.0) : mix(c, d, (t - 0.66) * 3.0);
}
void main() {
  vec2 middle = gl_PointCoord - 0.5;
  if (dot(middle, middle) > 0.25) discard;
  gl_FragColor = vec4(mix(ramp(clamp(height / 2.2, 0.0, 1.0)), fog, clamp((far - 14.0) / 30.0, 0.0, 0.75)), 1.0);
}`;
const ON_ROBOT = /base|body|lidar|radar|laser|sensor/;

function robot(accent) {
  const group = new Group();
  const shell = new MeshLambertMaterial({ color: 0xe7ecef });
  const dark = new MeshLambertMaterial({ color: 0x37414a });
  const add = (size, place, material, parent = group) => {
    const mesh = new Mesh(new BoxGeometry(...size), material);
    mesh.position.set(...place);
    parent.add(mesh);
    return mesh;
  };
  add([0.44, 0.2, 0.12], [0, 0, 0], shell);
  add([0.16, 0.14, 0.1], [0.28, 0, 0.04], dark);
  for (const x of [0.18, -0.18]) {
    for (const y of [0.13, -0.13]) {
      add([0.07, 0.05, 0.2], [x - 0.03, y, -0.1], dark).rotation.y = 0.5;
      add([0.05, 0.04, 0.2], [x - 0.03, y, -0.24], shell).rotation.y = -0.5;
    }
  }
  const heading = new Mesh(new ConeGeometry(0.07, 0.2, 20), new MeshLambertMaterial({ color: accent, emissive: accent, emissiveIntensity: 0.5 }));
  heading.rotation.z = -Math.PI / 2;
  heading.position.set(0.52, 0, 0.02);
  group.add(heading);
  return group;
}

export class CloudView {
  constructor(canvas) {
    this.renderer = new WebGLRenderer({ canvas, antialias: true, powerPreference: 'low-power' });
    this.scene = new Scene();
    this.camera = new PerspectiveCamera(50, 1, 0.05, 200);
    this.camera.up.set(0, 0, 1);
    this.camera.position.set(-2.3, -1.7, 2.0);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.enableDamping = false;
    this.controls.maxPolarAngle = Math.PI * 0.49;
    this.controls.minDistance = 0.8;
    this.controls.maxDistance = 60;
    this.controls.listenToKeyEvents(canvas);
    this.controls.addEventListener('change', () => this.ask(0));
    this.follows = true;
    this.material = new ShaderMaterial({ vertexShader: VERTEX, fragmentShader: FRAGMENT, uniforms: { size: { value: 26 }, fog: { value: new Color() } } });
    this.points = new Points(new BufferGeometry(), this.material);
    this.points.frustumCulled = false;
    this.robot = robot(0x06b6d4);
    this.robot.visible = false;
    this.path = new Line(new BufferGeometry(), new LineBasicMaterial({ color: 0x06b6d4 }));
    this.path.frustumCulled = false;
    const sun = new DirectionalLight(0xffffff, 2.2);
    sun.position.set(2, -3, 6);
    this.scene.add(new AmbientLight(0xffffff, 1.3), sun, this.points, this.robot, this.path);
    this.target = new Vector3();
    this.drawn = null;
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement);
    this.theme();
    matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => this.theme());
    this.resize();
  }

  theme() {
    const style = getComputedStyle(document.documentElement);
    const back = new Color(style.getPropertyValue('--stage').trim());
    this.scene.background = back;
    this.material.uniforms.fog.value = back;
    if (this.grid) this.scene.remove(this.grid);
    this.grid = new GridHelper(60, 60, new Color(style.getPropertyValue('--grid-strong').trim()), new Color(style.getPropertyValue('--grid').trim()));
    this.grid.rotation.x = Math.PI / 2;
    this.scene.add(this.grid);
    this.ask();
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.renderer.domElement.parentElement;
    if (!width || !height) return;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.ask();
  }

  cloud({ low, step, points, frame }, body, drawn) {
    const values = new Uint16Array(body.slice(0, points * 6).buffer);
    this.points.geometry.dispose();
    this.points.geometry = new BufferGeometry();
    this.points.geometry.setAttribute('position', new BufferAttribute(values, 3));
    this.points.scale.set(...step);
    this.points.position.set(...low);
    const parent = ON_ROBOT.test(frame) ? this.robot : this.scene;
    if (this.points.parent !== parent) parent.add(this.points);
    this.drawn = drawn;
    this.ask();
  }

  pose({ x, y, z, qx, qy, qz, qw }) {
    const before = this.robot.position.clone();
    this.robot.position.set(x, y, Math.max(z, 0.32));
    this.robot.quaternion.set(qx, qy, qz, qw);
    if (this.follows) {
      const moved = this.robot.visible ? this.robot.position.clone().sub(before) : this.robot.position.clone();
      this.camera.position.add(moved);
      this.controls.target.copy(this.robot.position);
    }
    this.robot.visible = true;
    this.ask();
  }

  trail(path) {
    const values = new Float32Array(path.length * 3);
    path.forEach(([x, y], place) => values.set([x, y, 0.03], place * 3));
    this.path.geometry.dispose();
    this.path.geometry = new BufferGeometry();
    this.path.geometry.setAttribute('position', new BufferAttribute(values, 3));
  }

  follow(on) {
    this.follows = on;
    if (on) this.controls.target.copy(this.robot.position);
    this.ask();
  }

  // Only when something changed, and so seldom that a machine without a graphics card keeps up with everything else.
  ask(pause = Math.max(50, 3 * (this.took ?? 0))) {
    if (this.asked) return;
    this.asked = true;
    const due = Math.max(0, pause - (performance.now() - (this.began ?? -1e9)));
    setTimeout(() => requestAnimationFrame(() => {
      this.asked = false;
      this.began = performance.now();
      this.controls.update();
      this.renderer.render(this.scene, this.camera);
      const drawn = this.drawn;
      this.drawn = null;
      drawn?.();
      this.took = performance.now() - this.began;
    }), due);
  }
}

const CELL = 0.06; // m
const SIDE = 1024; // cells
const LOWEST = 0.15;
const HIGHEST = 1.6;

export class FloorPlan {
  constructor(canvas) {
    this.canvas = canvas;
    this.cells = document.createElement('canvas');
    this.cells.width = this.cells.height = SIDE;
    this.plan = this.cells.getContext('2d', { willReadFrequently: true });
    this.hits = new Uint8Array(SIDE * SIDE);
    this.path = [];
    this.bounds = null;
    this.robot = null;
    this.cloudAt = 0;
    new ResizeObserver(() => this.draw()).observe(canvas.parentElement);
  }

  clear() {
    this.plan.clearRect(0, 0, SIDE, SIDE);
    this.hits.fill(0);
    this.path = [];
    this.bounds = this.robot = null;
  }

  // Where it went, all of it at once: x, y and yaw.
  trail(poses) {
    this.path = poses.map(([x, y]) => [x, y]);
    for (const [x, y] of this.path) this.reach(x / CELL + SIDE / 2, SIDE / 2 - y / CELL);
    const [x, y, yaw] = poses.at(-1) ?? [];
    this.robot = poses.length ? { x, y, yaw } : null;
  }

  cloud({ low, step, points, frame }, body, always = false) {
    const now = performance.now();
    if ((now - this.cloudAt < 500 && !always) || (ON_ROBOT.test(frame) && !this.robot)) return;
    this.cloudAt = now;
    const values = new Uint16Array(body.slice(0, points * 6).buffer);
    const { x: rx = 0, y: ry = 0, yaw = 0 } = ON_ROBOT.test(frame) ? this.robot : {};
    const [c, s] = [Math.cos(yaw), Math.sin(yaw)];
    const picture = this.plan.getImageData(0, 0, SIDE, SIDE);
    for (let at = 0; at < values.length; at += 3) {
      const z = low[2] + values[at + 2] * step[2];
      if (z < LOWEST || z > HIGHEST) continue;
      const px = low[0] + values[at] * step[0];
      const py = low[1] + values[at + 1] * step[1];
      const x = Math.floor((rx + c * px - s * py) / CELL) + SIDE / 2;
      const y = SIDE / 2 - Math.floor((ry + s * px + c * py) / CELL);
      if (x < 0 || y < 0 || x >= SIDE || y >= SIDE) continue;
      const cell = y * SIDE + x;
      const hits = (this.hits[cell] = Math.min(255, this.hits[cell] + 1));
      if (hits === 2 || always) this.reach(x, y);
      picture.data[cell * 4 + 3] = hits < 2 && !always ? 0 : Math.min(255, 90 + hits * 14);
    }
    this.plan.putImageData(picture, 0, 0);
  }

  reach(x, y) {
    const b = (this.bounds ??= { left: x, right: x, top: y, bottom: y });
    b.left = Math.min(b.left, x);
    b.right = Math.max(b.right, x);
    b.top = Math.min(b.top, y);
    b.bottom = Math.max(b.bottom, y);
  }

  pose({ x, y, qx, qy, qz, qw }) {
    this.robot = { x, y, yaw: Math.atan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz)) };
    const last = this.path.at(-1);
    if (last && Math.hypot(x - last[0], y - last[1]) < 0.05) return false;
    this.path.push([x, y]);
    if (this.path.length > 20000) this.path.splice(0, 1000);
    this.reach(x / CELL + SIDE / 2, SIDE / 2 - y / CELL);
    return true;
  }

  draw() {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    if (!width || !height) return;
    const ratio = Math.min(devicePixelRatio, 2);
    this.canvas.width = width * ratio;
    this.canvas.height = height * ratio;
    const style = getComputedStyle(this.canvas);
    const to = this.canvas.getContext('2d', { willReadFrequently: true }); // drawn by the processor, as the plots are
    to.fillStyle = style.getPropertyValue('--stage');
    to.fillRect(0, 0, this.canvas.width, this.canvas.height);
    if (!this.bounds) return;
    const { left, right, top, bottom } = this.bounds;
    const [spanX, spanY] = [Math.max(right - left, 60) + 24, Math.max(bottom - top, 60) + 24];
    const scale = Math.min(this.canvas.width / spanX, this.canvas.height / spanY);
    to.translate(this.canvas.width / 2, this.canvas.height / 2);
    to.scale(scale, scale);
    to.translate(-(left + right) / 2, -(top + bottom) / 2);
    to.imageSmoothingEnabled = false;
    to.filter = matchMedia('(prefers-color-scheme: dark)').matches ? 'invert(0.85)' : 'none';
    to.drawImage(this.cells, 0, 0);
    to.filter = 'none';
    const at = ([x, y]) => [x / CELL + SIDE / 2, SIDE / 2 - y / CELL];
    to.strokeStyle = style.getPropertyValue('--accent');
    to.lineWidth = (2.2 * ratio) / scale;
    to.lineJoin = to.lineCap = 'round';
    to.beginPath();
    for (const point of this.path) to.lineTo(...at(point));
    to.stroke();
    if (this.robot) {
      to.translate(...at([this.robot.x, this.robot.y]));
      to.rotate(-this.robot.yaw);
      const size = (9 * ratio) / scale;
      to.fillStyle = style.getPropertyValue('--accent');
      to.strokeStyle = style.getPropertyValue('--stage');
      to.beginPath();
      for (const [x, y] of [[1.2, 0], [-0.8, 0.8], [-0.4, 0], [-0.8, -0.8]]) to.lineTo(x * size, y * size);
      to.closePath();
      to.fill();
      to.stroke();
    }
    const meter = 5 / CELL;
    to.setTransform(1, 0, 0, 1, 0, 0);
    to.strokeStyle = to.fillStyle = style.getPropertyValue('--faint');
    to.lineWidth = 1.5 * ratio;
    to.font = `${11 * ratio}px system-ui, sans-serif`;
    to.beginPath();
    to.moveTo(12 * ratio, this.canvas.height - 12 * ratio);
    to.lineTo(12 * ratio + meter * scale, this.canvas.height - 12 * ratio);
    to.stroke();
    to.fillText('5 m', 12 * ratio, this.canvas.height - 18 * ratio);
  }
}
