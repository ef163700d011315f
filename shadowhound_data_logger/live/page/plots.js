// Figures over time: rows of float32 go into rings, and uPlot draws what they hold.
import { uPlot } from './vendor/uplot.js';

const MOST = 3600;

// Lines are drawn where the processor is: a browser without a graphics card is otherwise kept so busy by them that all that comes
// is late. uPlot asks for its canvas itself.
function inMemory(make) {
  const { getContext } = HTMLCanvasElement.prototype;
  HTMLCanvasElement.prototype.getContext = function (kind) { return getContext.call(this, kind, { willReadFrequently: true }); };
  try {
    return make();
  } finally {
    HTMLCanvasElement.prototype.getContext = getContext;
  }
}

export class Ring {
  constructor(seconds) {
    this.seconds = seconds;
    this.names = [];
    this.columns = [];
  }

  add({ names, rows }, body) {
    if (names.join() !== this.names.join()) {
      this.names = names;
      this.columns = [[], ...names.map(() => [])];
    }
    const view = new DataView(body.buffer, body.byteOffset, body.byteLength);
    for (let row = 0; row < rows; row += 1) {
      this.columns[0].push(view.getFloat64(row * 8, true) / 1000);
      for (let place = 0; place < names.length; place += 1) {
        this.columns[place + 1].push(view.getFloat32(rows * 8 + (row * names.length + place) * 4, true));
      }
    }
    const times = this.columns[0];
    if (times.length > MOST * 1.2 || times[0] < times.at(-1) - this.seconds * 1.5) {
      let first = Math.max(0, times.length - MOST);
      while (times[first] < times.at(-1) - this.seconds) first += 1;
      for (const column of this.columns) column.splice(0, first);
    }
  }

  clear() {
    this.names = [];
    this.columns = [];
  }

  last() {
    return Object.fromEntries(this.names.map((name, place) => [name, this.columns[place + 1].at(-1)]));
  }
}

const ago = (seconds) => (seconds < 90 ? `−${Math.round(seconds)} s` : `−${Math.round(seconds / 60)} min`);
const COLOURS = ['--line-1', '--line-2', '--line-3', '--line-4'];

export class Plot {
  // `lines`: [name in the ring, label, factor]; no lines: all that the ring has.
  constructor(box, ring, lines, { unit = '', seconds = 30, digits = 1, range = null } = {}) {
    Object.assign(this, { box, ring, lines, unit, seconds, digits, range });
    new ResizeObserver(() => this.make()).observe(box);
    matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => this.make());
  }

  chosen() {
    return this.lines ?? this.ring.names.map((name) => [name, name.replace(/_joint$/, ''), 1]);
  }

  make() {
    this.plot?.destroy();
    this.plot = null;
    const lines = this.chosen();
    const { clientWidth: width, clientHeight: height } = this.box;
    if (!width || !height || !lines.length) return;
    const style = getComputedStyle(this.box);
    const color = (name) => style.getPropertyValue(name).trim();
    const many = lines.length > COLOURS.length;
    this.made = lines.length;
    this.plot = inMemory(() => new uPlot(
      {
        width, height, padding: [8, 8, 0, 0], legend: { show: false }, cursor: { show: false }, pxAlign: true,
        scales: { x: { time: false, range: (_, low, high) => [high - this.seconds, high] }, y: this.range ? { range: this.range } : {} },
        axes: [
          { stroke: color('--faint'), grid: { stroke: color('--rule'), width: 1 }, ticks: { show: false }, font: '11px system-ui', size: 22,
            splits: (plot) => [0.9, 0.6, 0.3].map((share) => plot.scales.x.max - share * this.seconds),
            values: (_, ticks) => ticks.map((_tick, place) => ago([0.9, 0.6, 0.3][place] * this.seconds)) },
          { stroke: color('--faint'), grid: { stroke: color('--rule'), width: 1 }, ticks: { show: false }, font: '11px system-ui', size: 40, space: 28 },
        ],
        series: [{}, ...lines.map(([, label], place) => ({
          label, width: many ? 1 : 1.5, points: { show: false },
          stroke: many ? `hsl(${Math.round((place / lines.length) * 360)} 55% 52%)` : color(COLOURS[place % COLOURS.length]),
        }))],
      },
      this.data(lines), this.box,
    ));
  }

  data(lines) {
    const { names, columns } = this.ring;
    if (!columns.length) return [[], ...lines.map(() => [])];
    return [columns[0], ...lines.map(([name, , factor]) => {
      const column = columns[names.indexOf(name) + 1];
      if (!column || names.indexOf(name) < 0) return columns[0].map(() => null);
      return factor === 1 ? column : column.map((value) => value * factor);
    })];
  }

  draw() {
    const lines = this.chosen();
    if (!this.plot || this.made !== lines.length) this.make();
    this.plot?.setData(this.data(lines));
  }
}
