// What the page knows and what it watches, shared by its panels. A panel names what it needs (useWatch); what no panel needs is not sent.
import { batch, computed, signal, useEffect } from './vendor/preact.js';
import { past } from './past.js';
import { Ring } from './plots.js';

export const session = signal(null);
export const connection = signal('connecting');
export const figures = signal(null);
export const topics = signal([]); // [topic, kind, type, publishers]
export const total = signal(0); // of topics, those too that are more than the robot tells
export const problem = signal(''); // why no topics are read
export const problems = signal({}); // what is watched -> why it cannot be shown
export const seen = new Map(); // kind, or topic of a further camera -> { at } of what is shown, by the robot's clock
export const rings = { imu: new Ring(30), joints: new Ring(30), battery: new Ring(900), odom: new Ring(30), state: new Ring(30), fix: new Ring(900) };
export const pastRings = Object.fromEntries(Object.keys(rings).map((kind) => [kind, new Ring(10)]));
export const ringOf = (kind) => (past.value ? pastRings : rings)[kind];
export const views = {};
export const present = signal(null); // the robot's time, ms
export const shared = { link: null, video: null };

// What the operator chose for this robot: topics of panels, further cameras, plots of numbers, panels that are shown or not.
const NOTHING = { picked: {}, cameras: [], plots: [], panels: {} };
export const layout = signal(NOTHING);
const stored = () => `shadowhound.layout.${session.value?.robot ?? ''}`;
const texts = (list, most) => (Array.isArray(list) ? list.filter((each) => typeof each === 'string' && each.length < 500).slice(0, most) : []);
export const MOST_CAMERAS = 6;
export const MOST_PLOTS = 8;

export function loadLayout() {
  let found = {};
  try {
    found = JSON.parse(localStorage.getItem(stored())) ?? {};
  } catch { /* nothing is stored, or nothing of ours */ }
  layout.value = {
    picked: Object.fromEntries(Object.entries(found.picked ?? {}).filter((each) => texts(each, 2).length === 2)),
    cameras: texts(found.cameras, MOST_CAMERAS - 1), plots: texts(found.plots, MOST_PLOTS),
    panels: Object.fromEntries(Object.entries(found.panels ?? {}).filter(([, each]) => typeof each === 'boolean')),
  };
}

export function change(more) {
  layout.value = { ...layout.value, ...more };
  try {
    localStorage.setItem(stored(), JSON.stringify(layout.value));
  } catch { /* it is forgotten when the page is left */ }
}

// Topics of a kind that can be shown: [topic, kind, ...].
export const having = (kind) => (past.value ? past.value.shown : topics.value).filter(([, each]) => each === kind);
export const isLiving = ([, , , publishers]) => past.value !== null || publishers > 0;
export const living = (kind) => having(kind).filter(isLiving);

// The topic that the panel of a kind shows: as chosen, else one with a publisher, one that is logged, a compressed one, one of colors.
export function chosen(kind) {
  const found = having(kind);
  const wanted = found.find(([topic]) => topic === layout.value.picked[kind]);
  if (wanted) return wanted[0];
  const logged = new Set((figures.value?.topics ?? []).filter((row) => row.sensor && row.publishers).map((row) => row.topic));
  const rank = (row) => (isLiving(row) ? 0 : 8) + (logged.has(row[0]) ? 0 : 4) + (/depth/.test(row[0]) ? 2 : 0) + (String(row[2]).endsWith('/Image') ? 1 : 0);
  return found.sort((a, b) => rank(a) - rank(b) || (a[0] < b[0] ? -1 : 1))[0]?.[0];
}

export function pick(kind, topic) {
  change({ picked: { ...layout.value.picked, [kind]: topic } });
  rewatch();
}

// Whether the robot is one of Unitree's dogs, as far as its topics tell.
const GO2 = /^(go2_interfaces|unitree_go)\//;
export const isGo2 = computed(() => topics.value.some(([, , type, publishers]) => publishers > 0 && GO2.test(type)) || (figures.value?.topics ?? []).some(({ type, received }) => received > 0 && GO2.test(type))
  || (past.value?.shown ?? []).some(([topic]) => /go2|lowstate|utlidar/.test(topic)));

const watched = new Map(); // panel -> what gives the topics that it needs
export function rewatch() {
  const { link, video } = shared;
  video?.want(past.value ? null : chosen('camera') ?? null);
  const wanted = [...watched.values()].flatMap((each) => each()).filter((each) => each && each !== video?.shown);
  link?.watch(past.value ? [] : [...new Set(wanted)].sort());
}

// While the panel is there, watch the topics of these kinds, and whatever else `more` gives.
export function useWatch(kinds, more = () => []) {
  useEffect(() => {
    const me = {};
    watched.set(me, () => [...kinds.map(chosen), ...more()]);
    rewatch();
    return () => {
      watched.delete(me);
      rewatch();
    };
  }, [kinds.join(), more().join()]);
}

const NAMES = {
  camera: 'sensor_msgs/CompressedImage or Image', cloud: 'sensor_msgs/PointCloud2', odom: 'nav_msgs/Odometry', imu: 'sensor_msgs/Imu',
  joints: 'sensor_msgs/JointState', battery: 'sensor_msgs/BatteryState', fix: 'sensor_msgs/NavSatFix',
  diagnostics: 'diagnostic_msgs/DiagnosticArray', rosout: 'rcl_interfaces/Log', scan: 'sensor_msgs/LaserScan', map: 'nav_msgs/OccupancyGrid',
};

// Why a panel has nothing to show now; empty if it has, or if that is not known yet.
export function lacks(kind, topic = chosen(kind)) {
  if (past.value || problem.value || connection.value !== 'connected' || !topics.value.length) return '';
  const told = topics.value.find(([each]) => each === topic);
  if (!told) return `No topic of type ${NAMES[kind] ?? kind} is published.`;
  return problems.value[topic] || (told[3] > 0 ? '' : `Nobody publishes ${topic} now.`);
}

// Items of the kinds that are drawn by panels: each handler gets those of its kind.
const handlers = new Map();
export function useItems(kind, handler) {
  useEffect(() => {
    const all = handlers.get(kind) ?? new Set();
    handlers.set(kind, all.add(handler));
    return () => all.delete(handler);
  }, []);
}

export function give(head, body) {
  for (const handler of handlers.get(head.kind) ?? []) handler(head, body);
}

export function tellProblem({ topic, text }) {
  batch(() => {
    problems.value = { ...problems.value, [topic]: String(text) };
  });
}
