// The panels of the page: cameras, the 3D view, the plan, plots, GPS, diagnostics and the log.
import { html, signal, useEffect, useRef, useState } from './vendor/preact.js';
import { busy, past } from './past.js';
import { Plot, Ring, drag } from './plots.js';
import {
  MOST_CAMERAS, change, chosen, connection, having, isGo2, isLiving, lacks, layout, living, pick, present, problems, rings, ringOf, seen, session, shared, topics, useItems, useWatch, views,
} from './state.js';
import { Transforms } from './tf.js';
import { VideoChoice } from './video.js';
import { span } from './words.js';

export const calm = matchMedia('(prefers-reduced-motion: reduce)');
const OLD_MS = { camera: 1500, cloud: 2000, odom: 1500, imu: 1500, joints: 1500, battery: 5000, state: 2000, fix: 5000, scan: 1500, tf: 2000, diagnostics: 5000, figures: 4000, field: 5000 };
// Pictures are drawn where the processor is: without a graphics card all that comes would otherwise wait for the drawing of it.
export const IN_MEMORY = { willReadFrequently: true };

export function Age({ kind, of = kind, children }) {
  const [, again] = useState(0);
  useEffect(() => {
    const timer = setInterval(() => again((count) => count + 1), 100);
    return () => clearInterval(timer);
  }, []);
  if (past.value && kind !== 'figures') {
    const before = past.value.shown.find(([topic]) => topic === chosen(kind))?.[2];
    if (past.value.read === undefined) return html`<span class="age" data-age=${of}>${busy.value ? 'reading…' : ''}</span>${children}`;
    return html`<span class=${`age ${before === undefined ? 'old' : ''}`} data-age=${of} data-before=${before ?? ''} title="How long before the chosen moment this was recorded">${before === undefined ? 'nothing then' : `${span(Math.max(0, before) / 1000)} before`}</span>${children}`;
  }
  const at = seen.get(of)?.at;
  const now = shared.link?.now();
  const age = at === undefined || now === null || now === undefined ? null : Math.max(0, now - at);
  if (age === null && of !== 'figures' && lacks(kind)) return children; // the panel says why
  const isOld = age === null ? OLD_MS[kind] !== undefined : age > (OLD_MS[kind] ?? Infinity); // a log may be silent
  return html`<span class=${`age ${isOld ? 'old' : ''}`} data-age=${of} data-ms=${age === null ? '' : Math.round(age)} title="How long ago the newest message came to the robot’s computer">${age === null ? 'nothing yet' : isOld || age >= 1e4 ? `${span(age / 1000)} old` : `${Math.round(age)} ms`}</span>${children}`;
}

// Why nothing is shown, in place of it.
export function Why({ kind, topic, also = '' }) {
  const why = lacks(kind, topic) || also;
  return why && html`<p class="why" data-why=${kind}>${why}</p>`;
}

function FullScreen() {
  const toggle = (event) => (document.fullscreenElement ? document.exitFullscreen() : event.currentTarget.closest('section').requestFullscreen?.())?.catch(() => {});
  return document.fullscreenEnabled && html`<button type="button" class="icon" onClick=${toggle} aria-label="Full screen" title="Full screen; Escape ends it"><svg width="13" height="13" viewBox="0 0 13 13" aria-hidden="true"><path d="M1 4.5V1h3.5M8.5 1H12v3.5M12 8.5V12H8.5M4.5 12H1V8.5" fill="none" stroke="currentColor" stroke-width="1.6" /></svg></button>`;
}

const TITLES = {
  Camera: 'The newest frame of this topic, as the camera’s driver publishes it (CompressedImage or Image)',
  '3D view': 'The robot and what its sensors measure around it: points, scans and the map, placed by the transforms of /tf; in meters',
  Path: 'Where the robot went, seen from above, by its odometry or by /tf, on its map or on what its lidar measured; in meters',
  GPS: 'Where the robot went by its satellite receiver (NavSatFix), north up',
  Attitude: 'Roll, pitch and yaw in degrees, from the orientation that the IMU reports',
  Acceleration: 'Acceleration along the three axes of the IMU, in m/s²; it includes gravity',
  Joints: 'The angles of all joints in radians, as the robot publishes them',
  Battery: 'Charge in percent and voltage in volts of the last ten minutes, as the robot reports them',
  Temperature: 'Temperatures of the last ten minutes in °C, as the robot reports them',
  Diagnostics: 'The state of each part of the robot, as its programs report it (DiagnosticArray); errors are first',
  Log: 'What the programs of the robot log (/rosout); the newest line is first',
};

export function Panel({ title, kind, of, className = '', tools, choice = true, children }) {
  const found = choice ? having(kind).filter((row) => isLiving(row) || row[0] === chosen(kind)) : [];
  return html`<section class=${`panel view ${className}`} aria-label=${title}><div class="panel-head"><h3 title=${TITLES[title]}>${title}</h3>
    ${found.length > 1 && html`<select aria-label=${`Topic of ${title}`} value=${chosen(kind)} onChange=${(event) => pick(kind, event.target.value)}>
      ${found.map(([topic]) => html`<option>${topic}</option>`)}</select>`}
    ${tools}<${Age} kind=${kind} of=${of ?? kind} /></div>${children}</section>`;
}

// -- cameras -------------------------------------------------------------------------------------------------------------------

// Draws the newest frame; what comes while one is decoded replaces what waits.
class Frames {
  constructor(onDrawn) {
    this.onDrawn = onDrawn;
    this.decoding = false;
    this.waiting = null;
  }

  async show(head, body) {
    this.waiting = { head, body };
    if (this.decoding || !this.canvas) return;
    this.decoding = true;
    while (this.waiting) {
      const { head: now, body: jpeg } = this.waiting;
      this.waiting = null;
      try {
        const picture = await createImageBitmap(new Blob([jpeg], { type: 'image/jpeg' }));
        this.draw(picture, picture.width, picture.height);
        picture.close();
        this.onDrawn(now);
      } catch { /* a broken frame: the next one comes */ }
    }
    this.decoding = false;
  }

  draw(source, width, height) {
    const { canvas } = this;
    if (!canvas) return;
    if (canvas.width !== width) canvas.width = width;
    if (canvas.height !== height) canvas.height = height;
    canvas.getContext('2d', IN_MEMORY).drawImage(source, 0, 0);
  }
}

const scales = signal({}); // topic -> of which distances its colors are
export function noteScale({ topic, scale }) {
  const text = scale && [scale.low, scale.high].every(Number.isFinite) ? `${scale.low},${scale.high},${String(scale.unit).slice(0, 8)}` : '';
  if ((scales.value[topic] ?? '') !== text) scales.value = { ...scales.value, [topic]: text };
}

function Scale({ topic }) {
  const [low, high, unit] = (scales.value[topic] ?? '').split(',');
  return high && html`<div class="scale" data-scale=${topic} title="The distance that each color stands for; gray: nothing was measured"><b>${low}</b><i></i><b>${high} ${unit}</b></div>`;
}

function addCamera() {
  const shown = [chosen('camera'), ...layout.value.cameras];
  const next = living('camera').find(([topic]) => !shown.includes(topic));
  if (next) change({ cameras: [...layout.value.cameras, next[0]] });
}

export function Camera({ drawn }) {
  const canvas = useRef(null);
  useWatch(['camera']);
  useEffect(() => {
    views.camera = new Frames(drawn);
    views.camera.canvas = canvas.current;
    return () => { views.camera = null; };
  }, []);
  const { video } = shared;
  const topic = chosen('camera');
  const more = living('camera').length > 1 + layout.value.cameras.length && layout.value.cameras.length < MOST_CAMERAS - 1;
  return html`<${Panel} title="Camera" kind="camera" className="camera" tools=${html`${!past.value && more && html`<button type="button" class="icon" onClick=${addCamera} aria-label="Another camera beside this one" title="Another camera beside this one">+</button>`}
    ${video && !past.value && html`<${VideoChoice} video=${video} lacks=${session.value.no_video} />`}<${FullScreen} />`}>
    <div class="stage"><canvas ref=${canvas} width="640" height="480" role="img" aria-label="The newest frame of the camera"></canvas><${Why} kind="camera" /><${Scale} topic=${topic} /></div></${Panel}>`;
}

// A further camera, beside the first one.
export function OtherCamera({ topic }) {
  const canvas = useRef(null);
  const [frames] = useState(() => new Frames(() => {}));
  useWatch([], () => [topic]);
  useEffect(() => { frames.canvas = canvas.current; }, []);
  useItems('camera', (head, body) => {
    if (head.topic !== topic || topic === chosen('camera')) return;
    seen.set(`camera:${topic}`, { at: head.at });
    frames.show(head, body);
  });
  const end = () => change({ cameras: layout.value.cameras.filter((each) => each !== topic) });
  return html`<section class="panel view camera other" aria-label=${`Camera ${topic}`}><div class="panel-head"><h3 title=${`The newest frame of ${topic}`}>${topic}</h3><${FullScreen} />
    <button type="button" class="icon" onClick=${end} aria-label=${`Close ${topic}`} title="Close">×</button><${Age} kind="camera" of=${`camera:${topic}`} /></div>
    <div class="stage"><canvas ref=${canvas} width="640" height="480" role="img" aria-label=${`The newest frame of ${topic}`}></canvas><${Why} kind="camera" topic=${topic} /><${Scale} topic=${topic} /></div></section>`;
}

// -- the robot in space --------------------------------------------------------------------------------------------------------

export const transforms = new Transforms();
// Transforms are watched where the robot's place, or what is drawn, depends on them.
const PLACED = ['scan', 'map', 'model'];
const needsTransforms = () => !past.value && (PLACED.some((kind) => living(kind).length) || !living('odom').length);
const spaceTopics = () => [...PLACED.map(chosen), ...(needsTransforms() ? living('tf').map(([topic]) => topic).slice(0, 4) : [])];
const ageOfSpace = () => ['cloud', 'scan', 'odom', 'tf'].find((kind) => living(kind).length) ?? 'cloud';

export function Cloud() {
  const canvas = useRef(null);
  const [follows, setFollows] = useState(true);
  const [failed, setFailed] = useState('');
  const [notes, setNotes] = useState([]);
  useWatch(['cloud'], spaceTopics);
  useEffect(() => {
    // Most of the page's bytes are for this: they are loaded when it is in view.
    let isGone = false;
    const looking = new IntersectionObserver(([entry]) => {
      if (!entry.isIntersecting) return;
      looking.disconnect();
      import('./scene.js').then(({ CloudView }) => {
        if (isGone) return;
        views.cloud = new CloudView(canvas.current, { transforms, onNotes: setNotes, isDog: isGo2 });
        for (const [item, body] of views.late ?? []) views.cloud.take(item, body);
      }).catch(() => setFailed('This browser shows no 3D (WebGL).'));
    });
    looking.observe(canvas.current);
    return () => {
      isGone = true;
      looking.disconnect();
      views.cloud?.end();
      views.cloud = null;
    };
  }, []);
  const turn = () => { views.cloud?.follow(!follows); setFollows(!follows); };
  const kind = past.value ? 'cloud' : ageOfSpace();
  const drawn = past.value ? [] : ['cloud', 'scan', 'map', 'model'].filter((each) => living(each).length).map((each) => chosen(each));
  const nothing = !past.value && topics.value.length && !drawn.length && !living('odom').length && !living('tf').length;
  return html`<${Panel} title="3D view" kind=${kind} className="cloud" choice=${kind === 'cloud'} tools=${html`<button type="button" aria-pressed=${follows} onClick=${turn} title="Keep the robot in the middle">Follow</button><${FullScreen} />`}>
    <div class="stage">${failed && html`<p class="empty">${failed}</p>`}<canvas ref=${canvas} tabindex="0" role="img" aria-label="The robot and what its sensors measure around it; drag to turn (on a touch screen with two fingers), scroll to zoom, arrow keys to move"></canvas>
      ${nothing && html`<p class="why" data-why="cloud">No topic of type PointCloud2, LaserScan, OccupancyGrid, Odometry or TFMessage is published.</p>`}
      <ul class="notes">${drawn.map((topic) => html`<li>${topic}${problems.value[topic] ? html` <b class="watch">${problems.value[topic]}</b>` : ''}</li>`)}${notes.map((note) => html`<li class="watch" data-note>${note}</li>`)}</ul></div></${Panel}>`;
}

export function Plan() {
  const canvas = useRef(null);
  useWatch(['odom', 'cloud'], spaceTopics);
  useEffect(() => {
    let timer;
    import('./plan.js').then(({ FloorPlan }) => {
      views.plan = new FloorPlan(canvas.current, transforms);
      views.onPlan();
      timer = setInterval(() => !document.hidden && views.plan?.draw(), calm.matches ? 1000 : 250);
    });
    return () => {
      clearInterval(timer);
      views.plan = null;
    };
  }, []);
  const kind = past.value || living('odom').length || !living('tf').length ? 'odom' : 'tf';
  const nothing = kind === 'odom' && !living('scan').length && !living('map').length;
  return html`<${Panel} title="Path" kind=${kind} className="plan" choice=${kind === 'odom'} tools=${html`<${FullScreen} />`}><div class="stage"><canvas ref=${canvas} role="img" aria-label="Where the robot went, on its map or on the floor plan that its lidar makes"></canvas>${nothing && html`<${Why} kind="odom" />`}</div></${Panel}>`;
}

const DEFINITIONS = {
  'rpy.x': 'Rotation about the axis that points forward', 'rpy.y': 'Rotation about the axis that points left; positive: nose down', 'rpy.z': 'Rotation about the vertical axis, counterclockwise; it continues beyond 180°',
  'accel.x': 'Acceleration forward, as the IMU measures it', 'accel.y': 'Acceleration to the left, as the IMU measures it', 'accel.z': 'Acceleration upward, as the IMU measures it; gravity is included',
  battery: 'Charge of the battery, as the robot reports it', volts: 'Voltage of the battery', body: 'Temperature of the robot’s main board', motor: 'Temperature of the warmest motor', cells: 'Temperature of the warmest cell of the battery',
};

// -- plots ---------------------------------------------------------------------------------------------------------------------

export function Chart({ title, kind, lines, options, className = '', figure }) {
  const box = useRef(null);
  const [, again] = useState(0);
  useWatch([kind]);
  useEffect(() => {
    const plot = new Plot(box.current, rings[kind], lines, options);
    let rounds = 0;
    const timer = setInterval(() => {
      if (document.hidden) return;
      plot.ring = ringOf(kind);
      plot.seconds = past.value ? 10 : options.seconds ?? 30;
      plot.draw();
      if ((rounds += 1) % 4 === 0) again(rounds);
    }, calm.matches ? 1000 : 200);
    return () => {
      clearInterval(timer);
      plot.end();
    };
  }, []);
  const last = ringOf(kind).last();
  const told = ringOf(kind).names;
  const blank = lines && told.length && !lines.some(([name]) => Number.isFinite(last[name])) ? `${chosen(kind) ?? 'The topic'} has no such value.` : '';
  return html`<${Panel} title=${title} kind=${kind} className=${`chart ${className}`}><div class="legend small">
    ${(lines ?? []).map(([name, label, factor], place) => (!told.length || told.includes(name)) && html`<span draggable="true" title=${`${DEFINITIONS[name] ?? name}. Drag it onto another plot to compare.`} onDragStart=${(event) => drag(event, { kind, name, label, factor, unit: options.units?.[place] ?? options.unit })}><i class=${`stroke line-${place + 1}`}></i>${label} <b>${Number.isFinite(last[name]) ? (last[name] * factor).toFixed(options.digits ?? 1) : '–'}</b>${options.unit ? ` ${options.units?.[place] ?? options.unit}` : ''}</span>`)}
    ${!lines && html`<span title="Angles of all joints, as the robot publishes them">${figure(ringOf(kind).names.length)}</span>`}</div><div class="plot" ref=${box}></div><${Why} kind=${kind} also=${blank} /></${Panel}>`;
}

// A number of a topic, by its path, as the operator chose it in a message.
export function NumberPlot({ of }) {
  const box = useRef(null);
  const [ring] = useState(() => new Ring(60));
  const [, again] = useState(0);
  const [topic, path] = of.split('#');
  useWatch([], () => [of]);
  useItems('field', (head, body) => {
    if (head.topic !== of) return;
    seen.set(of, { at: head.at });
    ring.add(head, body);
  });
  useEffect(() => {
    const plot = new Plot(box.current, ring, [[path, path, 1]], { seconds: 60, digits: 3 });
    const timer = setInterval(() => {
      if (document.hidden) return;
      plot.draw();
      again((count) => count + 1);
    }, calm.matches ? 1000 : 250);
    return () => {
      clearInterval(timer);
      plot.end();
    };
  }, []);
  const value = ring.last()[path];
  const end = () => change({ plots: layout.value.plots.filter((each) => each !== of) });
  const why = problems.value[of] || (!past.value && topics.value.length && !(topics.value.find(([name]) => name === topic)?.[3] > 0) ? `Nobody publishes ${topic} now.` : '');
  return html`<section class="panel view chart number" aria-label=${`${path} of ${topic}`} data-plot=${of}><div class="panel-head"><h3 title=${`The value of ${path} in the messages of ${topic}, over the last minute`}>${path} <small>${topic}</small></h3>
    <button type="button" class="icon" onClick=${end} aria-label=${`Close the plot of ${path}`} title="Close">×</button>${!why && html`<${Age} kind="field" of=${of} />`}</div>
    <div class="legend small"><span><i class="stroke line-1"></i><b data-value title=${`${path} of ${topic}, the newest value`}>${value === undefined ? '–' : Number.isFinite(value) ? String(Number(value.toPrecision(6))) : String(value)}</b></span></div>
    <div class="plot" ref=${box}></div>${why && html`<p class="why" data-why=${of}>${why}</p>`}</section>`;
}

// -- GPS -----------------------------------------------------------------------------------------------------------------------

const FIXES = { '-2': '', '-1': 'no fix', 0: 'fix', 1: 'fix, with a satellite-based correction', 2: 'fix, with a ground-based correction' };
export function Gps() {
  const canvas = useRef(null);
  const [, again] = useState(0);
  useWatch(['fix']);
  useEffect(() => {
    let timer;
    import('./gps.js').then(({ GpsMap }) => {
      const map = new GpsMap(canvas.current, session.value.tiles);
      timer = setInterval(() => {
        if (document.hidden) return;
        map.draw(ringOf('fix'));
        again((count) => count + 1);
      }, calm.matches ? 1000 : 500);
    });
    return () => clearInterval(timer);
  }, []);
  const { lat, lat_rest, lon, lon_rest, altitude, status, error } = ringOf('fix').last();
  const has = Number.isFinite(lat) && Number.isFinite(lon);
  return html`<${Panel} title="GPS" kind="fix" className="plan gps" tools=${html`<${FullScreen} />`}><div class="legend small">
    <span title="Degrees north, WGS 84">latitude <b data-field="lat">${has ? (lat + lat_rest).toFixed(7) : '–'}</b></span><span title="Degrees east, WGS 84">longitude <b data-field="lon">${has ? (lon + lon_rest).toFixed(7) : '–'}</b></span>
    <span title="Above the WGS 84 ellipsoid">altitude <b>${Number.isFinite(altitude) ? altitude.toFixed(1) : '–'}</b> m</span><span title="What the receiver reports about its position, and the standard deviation of its longitude in meters, if it reports one">${status === undefined ? '' : FIXES[status] ?? `status ${status}`}${Number.isFinite(error) ? ` ±${error.toFixed(1)} m` : ''}</span></div>
    <div class="stage"><canvas ref=${canvas} role="img" aria-label="Where the robot went by GPS, north up"></canvas>${session.value.tiles && html`<small class="attribution">map: ${new URL(session.value.tiles.replaceAll(/[{}]/g, '')).host}</small>`}</div><${Why} kind="fix" /></${Panel}>`;
}

// -- lists ---------------------------------------------------------------------------------------------------------------------

const LEVELS = [['good', 'OK'], ['watch', 'warning'], ['bad', 'error'], ['bad', 'stale']];
const CLASSES = ['●', '▲', '■', '■'];
const rowsOf = (head) => (Array.isArray(head.rows) ? head.rows.filter(Array.isArray).slice(0, 300) : []);

export function Diagnostics() {
  const [rows, setRows] = useState([]);
  useWatch(['diagnostics']);
  useItems('diagnostics', (head) => head.topic === chosen('diagnostics') && setRows(rowsOf(head)));
  const level = (row) => Math.min(3, Math.max(0, Number(row[1]) || 0));
  const sorted = [...rows].sort((a, b) => level(b) - level(a) || (String(a[0]) < String(b[0]) ? -1 : 1));
  return html`<${Panel} title="Diagnostics" kind="diagnostics" className="list"><ul class="rows" hidden=${!rows.length} data-list="diagnostics">${sorted.map((row) => {
    const [kind, word] = LEVELS[level(row)];
    return html`<li key=${String(row[0])}><details><summary><span class=${`mark ${kind}`} role="img" aria-label=${word} title=${word}>${CLASSES[level(row)]}</span> <b>${String(row[0])}</b> ${String(row[2])}</summary>
      <dl>${row[3] ? html`<dt>hardware</dt><dd>${String(row[3])}</dd>` : ''}${(Array.isArray(row[4]) ? row[4] : []).map(([key, value]) => html`<dt>${String(key)}</dt><dd>${String(value)}</dd>`)}</dl></details></li>`;
  })}</ul>${!rows.length && html`<${Why} kind="diagnostics" also="Nothing has come since this panel was opened." />`}</${Panel}>`;
}

const SEVERITIES = [[10, 'debug', 'none'], [20, 'info', 'none'], [30, 'warning', 'watch'], [40, 'error', 'bad'], [50, 'fatal', 'bad']];
export function Log() {
  const [rows, setRows] = useState([]);
  const [least, setLeast] = useState(20);
  useWatch(['rosout']);
  useItems('rosout', (head) => head.topic === chosen('rosout') && setRows(rowsOf(head)));
  const now = present.value;
  const shown = rows.filter((row) => row[1] >= least).reverse();
  return html`<${Panel} title="Log" kind="rosout" className="list" tools=${html`<select aria-label="Least severity" title="Lines of this severity and above are shown" value=${least} onChange=${(event) => setLeast(Number(event.target.value))}>
    ${SEVERITIES.map(([number, word]) => html`<option value=${number}>${word}</option>`)}</select>`}><ul class="rows" hidden=${!shown.length} data-list="rosout">${shown.map((row) => {
    const [, word, kind] = SEVERITIES.find(([number]) => number >= row[1]) ?? SEVERITIES[4];
    return html`<li><small class="when">${now === null ? '' : span(Math.max(0, now - row[0]) / 1000)}</small> <b class=${kind}>${word}</b> <b>${String(row[2])}</b> ${String(row[3])}</li>`;
  })}</ul>${!shown.length && html`<${Why} kind="rosout" also=${connection.value === 'connected' ? 'No line of this severity has come since this panel was opened.' : ''} />`}</${Panel}>`;
}

// -- which panels there are ----------------------------------------------------------------------------------------------------

const DEGREES = 180 / Math.PI;
const ATTITUDE = [['rpy.x', 'roll', DEGREES], ['rpy.y', 'pitch', DEGREES], ['rpy.z', 'yaw', DEGREES]];
const FORCE = [['accel.x', 'x', 1], ['accel.y', 'y', 1], ['accel.z', 'z', 1]];
const POWER = [['battery', 'battery', 1], ['volts', 'voltage', 1]];
const HEAT = [['body', 'body', 1], ['motor', 'warmest motor', 1], ['cells', 'cells', 1]];

const chart = (title, kind, lines, options, more = {}) => [title, [kind], () => html`<${Chart} title=${title} kind=${kind} lines=${lines} options=${options} ...${more} />`];
// Title, kinds of topics by which it is shown unless it was chosen or hidden (none: always), what it is.
const PANELS = [
  ['3D view', [], () => html`<${Cloud} />`], ['Path', ['odom', 'cloud', 'scan', 'map', 'tf'], () => html`<${Plan} />`],
  ['GPS', ['fix'], () => html`<${Gps} />`],
  chart('Attitude', 'imu', ATTITUDE, { unit: '°' }), chart('Acceleration', 'imu', FORCE, { unit: 'm/s²' }),
  chart('Joints', 'joints', null, { unit: 'rad' }, { figure: (count) => `${count} ${count === 1 ? 'joint' : 'joints'}, rad` }),
  chart('Battery', 'battery', POWER, { unit: '%', units: ['%', 'V'], seconds: 600 }), chart('Temperature', 'battery', HEAT, { unit: '°C', seconds: 600, digits: 0 }),
  ['Diagnostics', ['diagnostics'], () => html`<${Diagnostics} />`, true], ['Log', ['rosout'], () => html`<${Log} />`, true],
];
const isShown = ([title, kinds, , isLive]) => (past.value && isLive ? false : layout.value.panels[title] ?? (!kinds.length || kinds.some((kind) => having(kind).length > 0)));

function PanelChoice() {
  const toggle = (panel) => change({ panels: { ...layout.value.panels, [panel[0]]: !isShown(panel) } });
  return html`<details class="menu"><summary title="Which panels are shown; this browser remembers it for this robot">Panels</summary><ul>${PANELS.map((panel) => html`<li><label><input type="checkbox" checked=${isShown(panel)} onChange=${() => toggle(panel)} /> ${panel[0]}</label></li>`)}</ul></details>`;
}

export function Views({ drawn }) {
  return html`<div class="views"><${Camera} drawn=${drawn} />${!past.value && layout.value.cameras.map((topic) => html`<${OtherCamera} key=${topic} topic=${topic} />`)}
    ${PANELS.filter(isShown).map((panel) => html`<${panel[2]} key=${panel[0]} />`)}
    ${!past.value && layout.value.plots.map((of) => html`<${NumberPlot} key=${of} of=${of} />`)}</div>${!past.value && html`<${PanelChoice} />`}`;
}
