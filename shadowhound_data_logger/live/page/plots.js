// Figures over time: rows of float32 go into rings, and uPlot draws what they hold.
import { uPlot } from './vendor/uplot.js';

const MOST = 3600;
const LEAST_BREAK_S = 0.75; // a pause that is shorter is not missing data
const YAW = 'rpy.z';
const FIELD = 'text/x-shadowhound-field';

// An angle that goes on over half a turn, instead of jumping by a whole one.
function unwrapped(values) {
  let turns = 0;
  return values.map((value, place) => {
    const step = place ? value - values[place - 1] : 0;
    if (step > Math.PI) turns -= 1;
    if (step < -Math.PI) turns += 1;
    return value + turns * 2 * Math.PI;
  });
}

// A field that is dragged from the legend of one plot to another one: { kind, name, label, factor, unit }.
export const drag = (event, field) => event.dataTransfer.setData(FIELD, JSON.stringify(field));

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

  // Rows of a time before all that are here.
  before({ names, rows }, body) {
    const older = new Ring(this.seconds);
    older.add({ names, rows }, body);
    if (!this.names.length) {
      this.names = older.names;
      this.columns = older.columns;
    } else if (older.columns.length) {
      const first = this.columns[0][0];
      const count = older.columns[0].filter((time) => time < first).length;
      const places = this.names.map((name) => older.names.indexOf(name));
      this.columns[0].unshift(...older.columns[0].slice(0, count));
      places.forEach((from, place) => this.columns[place + 1].unshift(...(from < 0 ? new Array(count).fill(NaN) : older.columns[from + 1].slice(0, count))));
    }
  }

  clear() {
    this.names = [];
    this.columns = [];
  }

  // Times and values of one name, null where nothing came for long: a line is not drawn through what is unknown.
  line(name) {
    const times = this.columns[0] ?? [];
    const values = this.columns[this.names.indexOf(name) + 1];
    return this.names.includes(name) ? [times, name === YAW ? unwrapped(values) : values] : [times, times.map(() => null)];
  }

  // Rows before which a line breaks.
  breaks() {
    const times = this.columns[0] ?? [];
    if (times.length < 3) return [];
    const steps = times.slice(1).map((time, place) => time - times[place]);
    // What is usual is the median of the neighboring steps: a bag has more messages than objects.
    const usual = (place) => {
      const near = steps.slice(Math.max(0, place - 2), place + 3).sort((a, b) => a - b);
      return near[(near.length - 1) >> 1];
    };
    return steps.flatMap((step, place) => (step > LEAST_BREAK_S && step > 4 * usual(place) ? [place + 1] : []));
  }

  last() {
    return Object.fromEntries(this.names.map((name, place) => [name, this.columns[place + 1].at(-1)]));
  }
}

const ago = (seconds) => (seconds < 90 ? `−${Math.round(seconds)} s` : `−${Math.round(seconds / 60)} min`);
const COLOURS = ['--line-1', '--line-2', '--line-3', '--line-4'];

// The values of a field at these times: the newest before each.
function sampled(ring, { name, factor = 1 }, times) {
  if (!ring?.names.includes(name)) return times.map(() => null);
  const [own, values] = ring.line(name);
  let at = -1;
  return times.map((time) => {
    while (at + 1 < own.length && own[at + 1] <= time) at += 1;
    return at < 0 || time - own[at] > 5 ? null : values[at] * factor;
  });
}

export class Plot {
  static rings = () => null; // the ring of a kind, for fields of other plots

  // `lines`: [name in the ring, label, factor]; no lines: all that the ring has.
  constructor(box, ring, lines, { unit = '', units = [], seconds = 30, digits = 1, range = null } = {}) {
    Object.assign(this, { box, ring, lines, unit, units, seconds, digits, range, others: [], tip: document.createElement('output') });
    this.tip.className = 'plot-tip';
    box.append(this.tip);
    box.addEventListener('dragover', (event) => { if (event.dataTransfer.types.includes(FIELD)) event.preventDefault(); });
    box.addEventListener('drop', (event) => {
      event.preventDefault();
      this.compare(JSON.parse(event.dataTransfer.getData(FIELD)));
    });
    this.sizes = new ResizeObserver(() => this.make());
    this.sizes.observe(box);
    this.schemes = matchMedia('(prefers-color-scheme: dark)');
    this.onScheme = () => this.make();
    this.schemes.addEventListener('change', this.onScheme);
  }

  end() {
    this.sizes.disconnect();
    this.schemes.removeEventListener('change', this.onScheme);
    this.plot?.destroy();
  }

  chosen() {
    return this.lines ?? this.ring.names.map((name) => [name, name.replace(/_joint$/, ''), 1]);
  }

  // Draw a field of another plot here too, on an axis of its own; once more takes it away.
  compare(field) {
    const isHere = this.others.some(({ kind, name }) => kind === field.kind && name === field.name);
    this.others = isHere ? this.others.filter(({ kind, name }) => kind !== field.kind || name !== field.name) : [...this.others, field].slice(-2);
    this.make();
  }

  // The unit of a line: those of another unit than the first one have the axis on the right.
  unitOf(place) {
    return this.units[place] ?? this.unit;
  }

  scaleOf(place) {
    return this.unitOf(place) === this.unitOf(0) ? 'y' : 'right';
  }

  hover(plot) {
    const { idx, left } = plot.cursor;
    this.tip.hidden = idx === null || idx === undefined || left < 0;
    if (this.tip.hidden) return;
    const names = [...this.chosen().map(([, label], place) => [label, this.unitOf(place)]), ...this.others.map(({ label, unit }) => [label, unit])];
    const said = names.map(([label, unit], place) => [label, plot.data[place + 1]?.[idx], unit]).filter(([, value]) => Number.isFinite(value)).slice(0, 6)
      .map(([label, value, unit]) => `${label} ${value.toFixed(this.digits)}${unit ? ` ${unit}` : ''}`);
    this.tip.textContent = [ago(plot.scales.x.max - plot.data[0][idx]), ...said].join(' · ');
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
    this.made = lines.length + this.others.length;
    const hasRight = this.others.length > 0 || lines.some((_, place) => this.scaleOf(place) === 'right');
    const axis = { stroke: color('--faint'), grid: { stroke: color('--rule'), width: 1 }, ticks: { show: false }, font: '11px system-ui', size: 40, space: 28 };
    this.plot = inMemory(() => new uPlot(
      {
        width, height, padding: [8, 8, 0, 0], legend: { show: false }, cursor: { y: false, drag: { x: false, y: false }, points: { show: false } }, hooks: { setCursor: [(plot) => this.hover(plot)] }, pxAlign: true,
        scales: { x: { time: false, range: (_, low, high) => [high - this.seconds, high] }, y: this.range ? { range: this.range } : {} },
        axes: [
          { stroke: color('--faint'), grid: { stroke: color('--rule'), width: 1 }, ticks: { show: false }, font: '11px system-ui', size: 22,
            splits: (plot) => [0.9, 0.6, 0.3].map((share) => plot.scales.x.max - share * this.seconds),
            values: (_, ticks) => ticks.map((_tick, place) => ago([0.9, 0.6, 0.3][place] * this.seconds)) },
          axis, ...(hasRight ? [{ ...axis, scale: 'right', side: 1, grid: { show: false } }] : []),
        ],
        series: [{}, ...lines.map(([, label], place) => ({
          label, width: many ? 1 : 1.5, points: { show: false }, scale: this.scaleOf(place), spanGaps: false,
          stroke: many ? `hsl(${Math.round((place / lines.length) * 360)} 55% 52%)` : color(COLOURS[place % COLOURS.length]),
        })), ...this.others.map(({ label }, place) => ({ label, width: 1.5, dash: [5, 3], points: { show: false }, scale: 'right', spanGaps: false, stroke: color(COLOURS[(lines.length + place) % COLOURS.length]) }))],
      },
      this.data(lines), this.box,
    ));
  }

  data(lines) {
    const { columns } = this.ring;
    const count = lines.length + this.others.length;
    if (!columns.length) return [[], ...Array.from({ length: count }, () => [])];
    const breaks = this.ring.breaks();
    const cut = (values, between) => {
      const found = [];
      let at = 0;
      for (const next of breaks) {
        found.push(...values.slice(at, next), between(next));
        at = next;
      }
      return found.concat(values.slice(at));
    };
    const [times] = columns;
    const all = breaks.length ? cut(times, (next) => (times[next - 1] + times[next]) / 2) : times;
    return [all, ...lines.map(([name, , factor]) => {
      const values = this.ring.line(name)[1].map((value) => (value === null || Number.isNaN(value) ? null : value * factor));
      return breaks.length ? cut(values, () => null) : values;
    }), ...this.others.map((field) => sampled(Plot.rings(field.kind), field, all))];
  }

  draw() {
    const lines = this.chosen();
    if (!this.plot || this.made !== lines.length + this.others.length) this.make();
    this.plot?.setData(this.data(lines));
  }
}
