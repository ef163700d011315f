// What the robot's sensors measure around it, in 3D, with the robot in it: by its own model, as a dog, or as a plain shape.
import {
  AmbientLight, AxesHelper, BoxGeometry, BufferAttribute, BufferGeometry, CanvasTexture, Color, ConeGeometry, DirectionalLight, GridHelper, Group, Line, LineBasicMaterial,
  LineSegments, Mesh, MeshBasicMaterial, MeshLambertMaterial, NearestFilter, OrbitControls, PerspectiveCamera, PlaneGeometry, Points, Scene, ShaderMaterial, SphereGeometry,
  TOUCH, URDFLoader, Vector3, WebGLRenderer,
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

const MOST_LINKS = 500; // of a robot's model
const DOG_HEIGHT = 0.32;

const shell = new MeshLambertMaterial({ color: 0xe7ecef });
const dark = new MeshLambertMaterial({ color: 0x37414a });
const accent = new MeshLambertMaterial({ color: 0x06b6d4, emissive: 0x06b6d4, emissiveIntensity: 0.5 });

function box(parent, size, place, material) {
  const mesh = new Mesh(new BoxGeometry(...size), material);
  mesh.position.set(...place);
  parent.add(mesh);
  return mesh;
}

function arrow(parent, length, place) {
  const heading = new Mesh(new ConeGeometry(length * 0.35, length, 20), accent);
  heading.rotation.z = -Math.PI / 2;
  heading.position.set(...place);
  parent.add(heading);
}

function dog() {
  const group = new Group();
  box(group, [0.44, 0.2, 0.12], [0, 0, 0], shell);
  box(group, [0.16, 0.14, 0.1], [0.28, 0, 0.04], dark);
  for (const x of [0.18, -0.18]) {
    for (const y of [0.13, -0.13]) {
      box(group, [0.07, 0.05, 0.2], [x - 0.03, y, -0.1], dark).rotation.y = 0.5;
      box(group, [0.05, 0.04, 0.2], [x - 0.03, y, -0.24], shell).rotation.y = -0.5;
    }
  }
  arrow(group, 0.2, [0.52, 0, 0.02]);
  return group;
}

// Of a robot whose shape is not known: its place and where it looks.
function plain() {
  const group = new Group();
  box(group, [0.36, 0.28, 0.12], [0, 0, 0.1], shell);
  arrow(group, 0.16, [0.26, 0, 0.1]);
  group.add(new AxesHelper(0.35));
  return group;
}

// A model from its description (URDF), without the files that it names: primitives as they are, and a line to each link that has none.
function modelOf(xml) {
  const text = new TextDecoder().decode(xml);
  if (/<!(DOCTYPE|ENTITY)/i.test(text)) throw new Error('it defines entities');
  const described = new DOMParser().parseFromString(text, 'text/xml');
  if (described.querySelector('parsererror') || !described.querySelector('robot')) throw new Error('it is not URDF');
  const links = described.querySelectorAll('link').length;
  if (links > MOST_LINKS) throw new Error(`it has ${links} links`);
  const meshes = described.querySelectorAll('visual mesh').length;
  for (const each of [...described.querySelectorAll('texture, mesh, collision, gazebo, transmission')]) (each.closest('visual geometry') ?? each).remove();
  for (const visual of [...described.querySelectorAll('visual')]) if (!visual.querySelector('geometry')) visual.remove();
  const model = new URDFLoader().parse(described);
  model.updateMatrixWorld(true);
  const from = new Vector3();
  const to = new Vector3();
  for (const joint of Object.values(model.joints)) {
    const length = from.setFromMatrixPosition(joint.parent.matrixWorld).distanceTo(to.setFromMatrixPosition(joint.matrixWorld));
    const line = new LineSegments(new BufferGeometry().setFromPoints([new Vector3(), joint.position.clone()]), new LineBasicMaterial({ color: 0x06b6d4 }));
    if (length > 0) joint.parent.add(line);
    joint.add(new Mesh(new SphereGeometry(0.012, 8, 6), accent));
  }
  return { model, meshes, links };
}

export class CloudView {
  constructor(canvas, { transforms, onNotes, isDog }) {
    Object.assign(this, { transforms, onNotes, isDog, notes: {} });
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
    // One finger scrolls the page, two turn the view; in full screen there is nothing to scroll.
    const touches = () => {
      const isAlone = Boolean(document.fullscreenElement?.contains(canvas));
      this.controls.touches = isAlone ? { ONE: TOUCH.ROTATE, TWO: TOUCH.DOLLY_PAN } : { ONE: null, TWO: TOUCH.DOLLY_ROTATE };
      canvas.style.touchAction = isAlone ? 'none' : 'pan-y';
    };
    document.addEventListener('fullscreenchange', touches);
    touches();
    this.follows = true;
    this.material = new ShaderMaterial({ vertexShader: VERTEX, fragmentShader: FRAGMENT, uniforms: { size: { value: 26 }, fog: { value: new Color() } } });
    this.points = new Points(new BufferGeometry(), this.material);
    this.rays = new Points(new BufferGeometry(), this.material);
    this.points.frustumCulled = this.rays.frustumCulled = false;
    [this.cloudAt, this.scanAt, this.mapAt] = [this.points, this.rays, null].map((points) => {
      const group = new Group();
      if (points) group.add(points);
      return group;
    });
    this.robot = new Group();
    this.robot.visible = false;
    this.path = new Line(new BufferGeometry(), new LineBasicMaterial({ color: 0x06b6d4 }));
    this.path.frustumCulled = false;
    const sun = new DirectionalLight(0xffffff, 2.2);
    sun.position.set(2, -3, 6);
    this.scene.add(new AmbientLight(0xffffff, 1.3), sun, this.robot, this.path, this.cloudAt, this.scanAt, this.mapAt);
    this.undo = isDog.subscribe(() => this.reshape());
    this.target = new Vector3();
    this.drawn = null;
    this.sizes = new ResizeObserver(() => this.resize());
    this.sizes.observe(canvas.parentElement);
    this.theme();
    this.schemes = matchMedia('(prefers-color-scheme: dark)');
    this.onScheme = () => this.theme();
    this.schemes.addEventListener('change', this.onScheme);
    this.resize();
  }

  end() {
    this.isEnded = true;
    this.undo();
    this.sizes.disconnect();
    this.schemes.removeEventListener('change', this.onScheme);
    this.controls.dispose();
    this.renderer.dispose();
  }

  // What cannot be drawn as it should be, and why; empty: it can.
  note(what, why) {
    if ((this.notes[what] ?? '') === why) return;
    this.notes[what] = why;
    this.onNotes(Object.values(this.notes).filter(Boolean));
  }

  // The robot's model, or else a shape.
  reshape() {
    this.shape?.removeFromParent();
    this.shape = this.model ?? (this.isDog.value ? dog() : plain());
    this.robot.add(this.shape);
    this.ask();
  }

  take(item, body, drawn) {
    const { kind } = item;
    if (kind === 'cloud') this.cloud(item, body, drawn);
    else if (kind === 'scan') this.scan(item, body);
    else if (kind === 'map') this.map(item, body);
    else if (kind === 'model') this.describe(body);
    else if (kind === 'tf') this.toTransforms();
  }

  // A group where its frame is: by the robot's transforms, on the robot by its name, or in the frame of odometry.
  place(group, frame, what) {
    const near = this.transforms.near(frame);
    const known = this.transforms.has(frame);
    const parent = !near && ON_ROBOT.test(frame) ? this.robot : this.scene;
    if (group.parent !== parent) parent.add(group);
    group.position.set(...(near?.place ?? [0, 0, 0]));
    group.quaternion.set(...(near?.turn ?? [0, 0, 0, 1]));
    this.note(what, !near && this.transforms.robot() ? `${what}: its frame ${frame || '(no name)'} is ${known ? 'not connected with the robot' : 'in no transform'}` : '');
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

  cloud({ topic, low, step, points, frame }, body, drawn) {
    const values = new Uint16Array(body.slice(0, points * 6).buffer);
    this.points.geometry.dispose();
    this.points.geometry = new BufferGeometry();
    this.points.geometry.setAttribute('position', new BufferAttribute(values, 3));
    this.points.scale.set(...step);
    this.points.position.set(...low);
    this.place(this.cloudAt, frame, topic);
    this.drawn = drawn;
    this.ask();
  }

  scan({ topic, frame, first, turn, step }, body) {
    const ranges = new Uint16Array(body.slice(0, body.length & ~1).buffer);
    const values = new Float32Array(ranges.length * 3);
    let count = 0;
    ranges.forEach((range, ray) => {
      if (!range) return;
      const angle = first + ray * turn;
      values.set([range * step * Math.cos(angle), range * step * Math.sin(angle), 0], count * 3);
      count += 1;
    });
    this.rays.geometry.dispose();
    this.rays.geometry = new BufferGeometry();
    this.rays.geometry.setAttribute('position', new BufferAttribute(values.slice(0, count * 3), 3));
    this.place(this.scanAt, frame, topic);
    this.ask();
  }

  map({ topic, width, height, resolution, x, y, yaw, frame }, cells) {
    const picture = document.createElement('canvas');
    picture.width = width;
    picture.height = height;
    const to = picture.getContext('2d', { willReadFrequently: true });
    const data = to.createImageData(width, height);
    for (let cell = 0; cell < cells.length; cell += 1) {
      const at = (height - 1 - Math.floor(cell / width)) * width * 4 + (cell % width) * 4;
      const shade = 255 - Math.min(100, cells[cell]) * 2.2;
      data.data.set([shade, shade, shade, cells[cell] > 100 ? 0 : cells[cell] ? 255 : 90], at);
    }
    to.putImageData(data, 0, 0);
    this.ground?.material.map.dispose();
    this.ground?.geometry.dispose();
    this.ground?.removeFromParent();
    const texture = new CanvasTexture(picture);
    texture.magFilter = NearestFilter;
    const size = [width * resolution, height * resolution];
    this.ground = new Mesh(new PlaneGeometry(...size), new MeshBasicMaterial({ map: texture, transparent: true, depthWrite: false }));
    const corner = new Group();
    corner.position.set(x, y, 0.005);
    corner.rotation.z = yaw;
    this.ground.position.set(size[0] / 2, size[1] / 2, 0);
    corner.add(this.ground);
    this.mapAt.clear();
    this.mapAt.add(corner);
    this.place(this.mapAt, frame, topic);
    this.ask();
  }

  describe(xml) {
    try {
      const { model, meshes, links } = modelOf(xml);
      this.model?.removeFromParent();
      this.model = model;
      this.robot.visible = true; // a robot without odometry and transforms, such as an arm, stands at the origin
      this.note('model', meshes ? `the model of ${links} links: meshes are files on the robot, which a page cannot fetch; joints are drawn instead` : '');
    } catch (error) {
      this.model = null;
      this.note('model', `the model of the robot cannot be drawn: ${error.message}`);
    }
    this.reshape();
  }

  // Joints of the model, by name.
  joints(values) {
    if (!this.model) return;
    for (const [name, value] of Object.entries(values)) if (Number.isFinite(value)) this.model.joints[name]?.setJointValue(value);
    this.ask();
  }

  pose({ x, y, z, qx, qy, qz, qw }) {
    if (!this.transforms.robot()) this.move([x, y, this.isDog.value ? Math.max(z, DOG_HEIGHT) : z], [qx, qy, qz, qw]);
  }

  // The robot's place by its transforms, if they tell it.
  toTransforms() {
    const robot = this.transforms.robot();
    const near = this.model && this.transforms.near(this.model.name ?? '');
    if (robot) this.move(...(near ? [near.place, near.turn] : [robot.place, robot.turn]));
  }

  move(place, turn) {
    const before = this.robot.position.clone();
    this.robot.position.set(...place);
    this.robot.quaternion.set(...turn);
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
    if (this.asked || this.isEnded) return;
    this.asked = true;
    const due = Math.max(0, pause - (performance.now() - (this.began ?? -1e9)));
    setTimeout(() => requestAnimationFrame(() => {
      this.asked = false;
      if (this.isEnded) return;
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
