// Where frames are in space: the newest transform of each, put together up to the root of its tree.
const MOST_FRAMES = 400;
const DEEPEST = 64;
const ROBOT = ['base_link', 'base_footprint', 'base', 'body'];

const turned = ([qx, qy, qz, qw], [x, y, z]) => {
  const [tx, ty, tz] = [2 * (qy * z - qz * y), 2 * (qz * x - qx * z), 2 * (qx * y - qy * x)];
  return [x + qw * tx + qy * tz - qz * ty, y + qw * ty + qz * tx - qx * tz, z + qw * tz + qx * ty - qy * tx];
};
const product = ([ax, ay, az, aw], [bx, by, bz, bw]) => [
  aw * bx + ax * bw + ay * bz - az * by, aw * by - ax * bz + ay * bw + az * bx, aw * bz + ax * by - ay * bx + az * bw, aw * bw - ax * bx - ay * by - az * bz,
];
export const yawOf = ([x, y, z, w]) => Math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z));

export class Transforms {
  constructor() {
    this.of = new Map(); // child -> { topic, parent, place, turn }
  }

  // An item of a topic has all frames that this topic has now.
  add({ topic, frames }, body) {
    const view = new DataView(body.buffer, body.byteOffset, body.byteLength);
    for (const [child, { topic: other }] of this.of) if (other === topic) this.of.delete(child);
    frames.slice(0, MOST_FRAMES).forEach(([parent, child], row) => {
      const [x, y, z, ...turn] = Array.from({ length: 7 }, (_, place) => view.getFloat32((row * 7 + place) * 4, true));
      if (this.of.size < MOST_FRAMES) this.of.set(String(child), { topic, parent: String(parent), place: [x, y, z], turn });
    });
  }

  clear() {
    this.of.clear();
  }

  has(frame) {
    return this.of.has(frame) || [...this.of.values()].some(({ parent }) => parent === frame);
  }

  // The pose of a frame in the root of its tree; null where the frame is not known.
  pose(frame) {
    frame = String(frame).replace(/^\//, '');
    if (!this.has(frame)) return null;
    let [place, turn, root] = [[0, 0, 0], [0, 0, 0, 1], frame];
    for (let depth = 0; depth < DEEPEST && this.of.has(root); depth += 1) {
      const above = this.of.get(root);
      place = turned(above.turn, place).map((value, axis) => value + above.place[axis]);
      turn = product(above.turn, turn);
      root = above.parent;
    }
    return { root, place, turn };
  }

  // The frame that is the robot, by its usual names, and with the prefix of a namespace; the one nearest to the root.
  base() {
    const all = [...new Set([...this.of.keys(), ...[...this.of.values()].map(({ parent }) => parent)])];
    for (const name of ROBOT) {
      const found = all.filter((frame) => frame === name || frame.endsWith(`/${name}`)).sort((a, b) => a.length - b.length)[0];
      if (found) return found;
    }
    return null;
  }

  // Where the robot is, if transforms tell: { root, place, turn } of its base in a frame that is not itself.
  robot() {
    const base = this.base();
    const pose = base && this.pose(base);
    return pose && pose.root !== base ? pose : null;
  }

  // The pose of a frame beside the robot; null where it is not connected with it.
  near(frame) {
    const [pose, robot] = [this.pose(frame), this.robot()];
    return pose && robot && pose.root === robot.root ? pose : null;
  }
}
