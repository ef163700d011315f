// The floor plan: the robot's map, or what its lidar sees at the height of walls, with the way that the robot went.
import { yawOf } from './tf.js';

const ON_ROBOT = /base|body|lidar|radar|laser|sensor/;
const CELL = 0.06; // m
const SIDE = 1024; // cells
const LOWEST = 0.15;
const HIGHEST = 1.6;

export class FloorPlan {
  constructor(canvas, transforms) {
    this.canvas = canvas;
    this.transforms = transforms;
    this.grid = this.dots = null;
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
    this.bounds = this.robot = this.grid = this.dots = null;
  }

  // Where a frame is on the plan: by the robot's transforms, on the robot by its name, or it is the plan's own.
  placed(frame) {
    const near = this.transforms.near(frame);
    if (near) return { x: near.place[0], y: near.place[1], z: near.place[2], yaw: yawOf(near.turn) };
    return ON_ROBOT.test(frame) ? this.robot && { z: 0, ...this.robot } : { x: 0, y: 0, z: 0, yaw: 0 };
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
    const place = this.placed(frame);
    if ((now - this.cloudAt < 500 && !always) || !place) return;
    this.cloudAt = now;
    const values = new Uint16Array(body.slice(0, points * 6).buffer);
    const [c, s] = [Math.cos(place.yaw), Math.sin(place.yaw)];
    const picture = this.plan.getImageData(0, 0, SIDE, SIDE);
    for (let at = 0; at < values.length; at += 3) {
      const z = place.z + low[2] + values[at + 2] * step[2];
      if (z < LOWEST || z > HIGHEST) continue;
      const px = low[0] + values[at] * step[0];
      const py = low[1] + values[at + 1] * step[1];
      const x = Math.floor((place.x + c * px - s * py) / CELL) + SIDE / 2;
      const y = SIDE / 2 - Math.floor((place.y + s * px + c * py) / CELL);
      if (x < 0 || y < 0 || x >= SIDE || y >= SIDE) continue;
      const cell = y * SIDE + x;
      const hits = (this.hits[cell] = Math.min(255, this.hits[cell] + 1));
      if (hits === 2 || always) this.reach(x, y);
      picture.data[cell * 4 + 3] = hits < 2 && !always ? 0 : Math.min(255, 90 + hits * 14);
    }
    this.plan.putImageData(picture, 0, 0);
  }

  // A laser scan: what it hits now; without a map it is remembered as the points of a cloud are.
  scan({ frame, first, turn, step }, body) {
    const place = this.placed(frame);
    if (!place) return;
    const ranges = new Uint16Array(body.slice(0, body.length & ~1).buffer);
    const dots = [];
    const remembers = !this.grid && performance.now() - this.cloudAt > 200;
    const picture = remembers ? this.plan.getImageData(0, 0, SIDE, SIDE) : null;
    ranges.forEach((range, ray) => {
      if (!range) return;
      const angle = place.yaw + first + ray * turn;
      const [x, y] = [place.x + range * step * Math.cos(angle), place.y + range * step * Math.sin(angle)];
      dots.push([x, y]);
      if (!remembers) return;
      const [column, row] = [Math.floor(x / CELL) + SIDE / 2, SIDE / 2 - Math.floor(y / CELL)];
      if (column < 0 || row < 0 || column >= SIDE || row >= SIDE) return;
      const cell = row * SIDE + column;
      this.hits[cell] = Math.min(255, this.hits[cell] + 1);
      if (this.hits[cell] === 2) this.reach(column, row);
      picture.data[cell * 4 + 3] = this.hits[cell] < 2 ? 0 : Math.min(255, 90 + this.hits[cell] * 14);
    });
    if (remembers) {
      this.cloudAt = performance.now();
      this.plan.putImageData(picture, 0, 0);
    }
    this.dots = dots;
  }

  // A map of the robot: cells of 0 (free) to 100 (occupied), 255 where that is not known.
  map({ width, height, resolution, x, y, yaw, frame }, cells) {
    const place = this.placed(frame) ?? { x: 0, y: 0, yaw: 0 };
    const picture = document.createElement('canvas');
    picture.width = width;
    picture.height = height;
    const to = picture.getContext('2d', { willReadFrequently: true });
    const data = to.createImageData(width, height);
    for (let cell = 0; cell < cells.length; cell += 1) {
      const at = (Math.floor(cell / width) * -1 + height - 1) * width * 4 + (cell % width) * 4; // its first row is the lowest
      const shade = cells[cell] > 100 ? 205 : 255 - cells[cell] * 2.3;
      data.data.set([shade, shade, shade, cells[cell] > 100 ? 60 : 255], at);
    }
    to.putImageData(data, 0, 0);
    const [c, s] = [Math.cos(place.yaw), Math.sin(place.yaw)];
    this.grid = { picture, size: [width * resolution, height * resolution], x: place.x + c * x - s * y, y: place.y + s * x + c * y, yaw: place.yaw + yaw };
    const [gc, gs] = [Math.cos(this.grid.yaw), Math.sin(this.grid.yaw)];
    for (const [u, v] of [[0, 0], [1, 0], [0, 1], [1, 1]]) {
      const [right, up] = [u * this.grid.size[0], v * this.grid.size[1]];
      this.reach((this.grid.x + gc * right - gs * up) / CELL + SIDE / 2, SIDE / 2 - (this.grid.y + gs * right + gc * up) / CELL);
    }
  }

  // The robot's place by its transforms, if they tell it: then odometry is not used.
  follow() {
    const robot = this.transforms.robot();
    return robot && this.went(robot.place[0], robot.place[1], yawOf(robot.turn));
  }

  reach(x, y) {
    const b = (this.bounds ??= { left: x, right: x, top: y, bottom: y });
    b.left = Math.min(b.left, x);
    b.right = Math.max(b.right, x);
    b.top = Math.min(b.top, y);
    b.bottom = Math.max(b.bottom, y);
  }

  pose({ x, y, qx, qy, qz, qw }) {
    return !this.transforms.robot() && this.went(x, y, yawOf([qx, qy, qz, qw]));
  }

  // Whether the path grew.
  went(x, y, yaw) {
    this.robot = { x, y, yaw };
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
    const at = ([x, y]) => [x / CELL + SIDE / 2, SIDE / 2 - y / CELL];
    to.filter = matchMedia('(prefers-color-scheme: dark)').matches ? 'invert(0.85)' : 'none';
    if (this.grid) {
      const { picture, size, x, y, yaw } = this.grid;
      to.save();
      to.translate(...at([x, y]));
      to.rotate(-yaw);
      to.drawImage(picture, 0, -size[1] / CELL, size[0] / CELL, size[1] / CELL);
      to.restore();
    } else to.drawImage(this.cells, 0, 0);
    to.filter = 'none';
    if (this.dots) {
      const size = (1.6 * ratio) / scale;
      to.fillStyle = style.getPropertyValue('--line-2');
      for (const dot of this.dots) {
        const [x, y] = at(dot);
        to.fillRect(x - size / 2, y - size / 2, size, size);
      }
    }
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
