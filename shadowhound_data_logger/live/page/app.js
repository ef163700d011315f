// The live page: what the robot sees now, its data, and what is missing.
import { batch, html, render, signal, useEffect, useRef, useState } from './vendor/preact.js';
import { Cards, Controls, Findings, TopicTable } from './data.js';
import { Link } from './link.js';
import { Plot, Ring } from './plots.js';
import { busy, openRobot, past, show } from './past.js';
import { Timeline } from './timeline.js';
import { Video, VideoChoice } from './video.js';
import { span } from './words.js';

const calm = matchMedia('(prefers-reduced-motion: reduce)');
const OLD_MS = { camera: 1500, cloud: 2000, odom: 1500, imu: 1500, joints: 1500, battery: 5000, state: 2000, figures: 4000 };
const session = signal(null);
const connection = signal('connecting');
const figures = signal(null);
const topics = signal([]);
const problem = signal('');
const picked = signal({});
const seen = new Map(); // kind -> { at } of what is shown, by the robot's clock
const rings = { imu: new Ring(30), joints: new Ring(30), battery: new Ring(900), odom: new Ring(30), state: new Ring(30) };
const pastRings = Object.fromEntries(Object.keys(rings).map((kind) => [kind, new Ring(10)]));
const views = {};
const ringOf = (kind) => (past.value ? pastRings : rings)[kind];
// Pictures are drawn where the processor is: without a graphics card all that comes would otherwise wait for the drawing of it.
const IN_MEMORY = { willReadFrequently: true };
// For whoever measures: how late items were when they came and when they were drawn, ms.
const stats = (window.shadowhound = { came: {}, drawn: {}, count: {}, link: null, ages: () => Object.fromEntries([...seen].map(([kind, { at }]) => [kind, link.now() - at])), at: () => Object.fromEntries([...seen].map(([kind, { at }]) => [kind, at])) });
let link;
let video;
const present = signal(null); // the robot's time, ms
setInterval(() => { if (!document.hidden) present.value = link?.now() ?? null; }, 100);

function note(where, kind, at) {
  const now = link?.now() ?? null;
  if (now !== null && !past.value) (where[kind] ??= []).push(now - at);
  if (where[kind]?.length > 4000) where[kind].splice(0, 2000);
}

// [topic, kind, type] of what can be shown.
const having = (kind) => (past.value ? past.value.shown : topics.value).filter(([, each]) => each === kind);

function chosen(kind) {
  const found = having(kind);
  const wanted = found.find(([topic]) => topic === picked.value[kind]);
  if (wanted) return wanted[0];
  const logged = new Set((figures.value?.topics ?? []).filter((row) => row.sensor && row.publishers).map((row) => row.topic));
  const rank = ([topic, , type]) => (logged.has(topic) ? 0 : 2) + (String(type).endsWith('/Image') ? 1 : 0);
  return found.sort((a, b) => rank(a) - rank(b) || (a[0] < b[0] ? -1 : 1))[0]?.[0];
}

const KINDS = ['camera', 'cloud', 'odom', 'imu', 'joints', 'battery', 'state'];
function rewatch() {
  video?.want(past.value ? null : chosen('camera') ?? null);
  link?.watch(past.value ? [] : KINDS.map(chosen).filter((topic) => topic && topic !== video?.shown));
}

let decoding = false;
let waiting = null;
async function showFrame(head, body) {
  waiting = { head, body };
  if (decoding || !views.camera) return;
  decoding = true;
  while (waiting) {
    const { head: now, body: jpeg } = waiting;
    waiting = null;
    try {
      const picture = await createImageBitmap(new Blob([jpeg], { type: 'image/jpeg' }));
      const canvas = views.camera;
      if (canvas.width !== picture.width) canvas.width = picture.width;
      if (canvas.height !== picture.height) canvas.height = picture.height;
      canvas.getContext('2d', IN_MEMORY).drawImage(picture, 0, 0);
      picture.close();
      note(stats.drawn, 'camera', now.at);
      stats.first ??= performance.now();
    } catch { /* a broken frame: the next one comes */ }
  }
  decoding = false;
}

function drawVideo(element, at) {
  const canvas = views.camera;
  if (past.value || !canvas) return;
  note(stats.came, 'camera', at);
  seen.set('camera', { at });
  stats.count.camera = (stats.count.camera ?? 0) + 1;
  if (canvas.width !== element.videoWidth) canvas.width = element.videoWidth;
  if (canvas.height !== element.videoHeight) canvas.height = element.videoHeight;
  canvas.getContext('2d', IN_MEMORY).drawImage(element, 0, 0);
  note(stats.drawn, 'camera', at);
}

function onItem(head, body) {
  const { kind } = head;
  if (kind === 'video') return video.take(head);
  if (past.value && kind !== 'topics' && kind !== 'figures') return; // on its way when somebody looked back
  stats.count[kind] = (stats.count[kind] ?? 0) + 1;
  if (head.at !== undefined) {
    seen.set(kind, { at: head.at });
    note(stats.came, kind, head.at);
  }
  if (kind === 'topics') {
    batch(() => {
      topics.value = head.topics;
      problem.value = head.problem;
    });
    rewatch();
  } else if (kind === 'figures') {
    figures.value = { ...head.figures, at: head.at };
    document.title = `${head.figures.robot} · live`;
    rewatch();
  } else if (kind === 'camera') {
    showFrame(head, body);
  } else if (kind === 'cloud') {
    views.cloud?.cloud(head, body, () => note(stats.drawn, 'cloud', head.at));
    views.plan?.cloud(head, body);
  } else if (rings[kind]) {
    rings[kind].add(head, body);
    if (kind === 'odom') {
      const pose = rings.odom.last();
      views.cloud?.pose(pose);
      if (views.plan?.pose(pose)) views.cloud?.trail(views.plan.path);
    }
  }
}

// Of a moment that is past, all there is of it, at once.
show((head, items) => {
  rewatch();
  for (const ring of Object.values(pastRings)) ring.clear();
  for (const [item, body] of items) {
    const { kind, topic } = item;
    if (kind === 'path') {
      const view = new DataView(body.buffer);
      const poses = Array.from({ length: item.points }, (_, row) => [0, 1, 2].map((place) => view.getFloat32((row * 3 + place) * 4, true)));
      views.plan?.trail(poses);
      views.cloud?.trail(poses);
    } else if (topic !== chosen(kind)) {
      // another topic of the kind is shown
    } else if (kind === 'camera') {
      showFrame(item, body);
    } else if (kind === 'cloud') {
      views.cloud?.cloud(item, body);
      views.plan?.cloud(item, body, true);
    } else if (pastRings[kind]) {
      pastRings[kind].add(item, body);
      if (kind === 'odom') {
        views.cloud?.pose(pastRings.odom.last());
        views.plan?.pose(pastRings.odom.last());
      }
    }
  }
  stats.past = { at: head.at, shown: head.shown, count: (stats.past?.count ?? 0) + 1 };
});
let wasPast = false;
past.subscribe((now) => {
  if (Boolean(now) === wasPast) return;
  wasPast = Boolean(now);
  views.plan?.clear();
  views.cloud?.trail([]);
  rewatch();
});

function Age({ kind, children }) {
  const [, again] = useState(0);
  useEffect(() => {
    const timer = setInterval(() => again((count) => count + 1), 100);
    return () => clearInterval(timer);
  }, []);
  if (past.value && kind !== 'figures') {
    const before = past.value.shown.find(([topic]) => topic === chosen(kind))?.[2];
    if (past.value.read === undefined) return html`<span class="age" data-age=${kind}>${busy.value ? 'reading…' : ''}</span>${children}`;
    return html`<span class=${`age ${before === undefined ? 'old' : ''}`} data-age=${kind} data-before=${before ?? ''}>${before === undefined ? 'nothing then' : `${span(Math.max(0, before) / 1000)} before`}</span>${children}`;
  }
  const at = seen.get(kind)?.at;
  const now = link?.now();
  const age = at === undefined || now === null || now === undefined ? null : Math.max(0, now - at);
  const isOld = age === null || age > OLD_MS[kind];
  return html`<span class=${`age ${isOld ? 'old' : ''}`} data-age=${kind} data-ms=${age === null ? '' : Math.round(age)}>${age === null ? 'nothing yet' : isOld ? `${span(age / 1000)} old` : `${Math.round(age)} ms`}</span>${children}`;
}

function Panel({ title, kind, className = '', tools, children }) {
  const found = having(kind);
  return html`<section class=${`panel view ${className}`} aria-label=${title}><div class="panel-head"><h3>${title}</h3>
    ${found.length > 1 && html`<select aria-label=${`Topic of ${title}`} value=${chosen(kind)} onChange=${(event) => { picked.value = { ...picked.value, [kind]: event.target.value }; rewatch(); }}>
      ${found.map(([topic]) => html`<option>${topic}</option>`)}</select>`}
    ${tools}<${Age} kind=${kind} /></div>${children}</section>`;
}

function Camera() {
  const canvas = useRef(null);
  useEffect(() => { views.camera = canvas.current; }, []);
  return html`<${Panel} title="Camera" kind="camera" className="camera" tools=${video && !past.value && html`<${VideoChoice} video=${video} lacks=${session.value.no_video} />`}><div class="stage"><canvas ref=${canvas} width="640" height="480" role="img" aria-label="The newest frame of the camera"></canvas></div></${Panel}>`;
}

function Cloud() {
  const canvas = useRef(null);
  const [follows, setFollows] = useState(true);
  const [lacks, setLacks] = useState('');
  useEffect(() => {
    import('./scene.js').then(({ CloudView }) => { views.cloud = new CloudView(canvas.current); }).catch(() => setLacks('This browser shows no 3D (WebGL).'));
  }, []);
  const turn = () => { views.cloud?.follow(!follows); setFollows(!follows); };
  return html`<${Panel} title="Point cloud" kind="cloud" className="cloud" tools=${html`<button type="button" aria-pressed=${follows} onClick=${turn} title="Keep the robot in the middle">Follow</button>`}>
    <div class="stage">${lacks && html`<p class="empty">${lacks}</p>`}<canvas ref=${canvas} tabindex="0" role="img" aria-label="The points of the lidar around the robot; drag to turn, scroll to zoom, arrow keys to move"></canvas></div></${Panel}>`;
}

function Plan() {
  const canvas = useRef(null);
  useEffect(() => {
    let timer;
    import('./scene.js').then(({ FloorPlan }) => {
      views.plan = new FloorPlan(canvas.current);
      timer = setInterval(() => !document.hidden && views.plan.draw(), calm.matches ? 1000 : 250);
    });
    return () => clearInterval(timer);
  }, []);
  return html`<${Panel} title="Path" kind="odom" className="plan"><div class="stage"><canvas ref=${canvas} role="img" aria-label="Where the robot went, on the floor plan that its lidar makes"></canvas></div></${Panel}>`;
}

function Chart({ title, kind, lines, options, className = '', figure }) {
  const box = useRef(null);
  const [, again] = useState(0);
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
    return () => clearInterval(timer);
  }, []);
  const last = ringOf(kind).last();
  return html`<${Panel} title=${title} kind=${kind} className=${`chart ${className}`}><div class="legend small">
    ${(lines ?? []).map(([name, label, factor], place) => html`<span><i class=${`stroke line-${place + 1}`}></i>${label} <b>${last[name] === undefined ? '–' : (last[name] * factor).toFixed(options.digits ?? 1)}</b>${options.unit ? ` ${options.units?.[place] ?? options.unit}` : ''}</span>`)}
    ${!lines && html`<span>${ringOf(kind).names.length} ${figure}</span>`}</div><div class="plot" ref=${box}></div></${Panel}>`;
}

const DEGREES = 180 / Math.PI;
const ATTITUDE = [['rpy.x', 'roll', DEGREES], ['rpy.y', 'pitch', DEGREES], ['rpy.z', 'yaw', DEGREES]];
const FORCE = [['accel.x', 'x', 1], ['accel.y', 'y', 1], ['accel.z', 'z', 1]];
const POWER = [['battery', 'battery', 1], ['volts', 'voltage', 1]];
const HEAT = [['body', 'body', 1], ['motor', 'warmest motor', 1], ['cells', 'cells', 1]];

function SignIn({ box, why, onDone }) {
  const [wrong, setWrong] = useState('');
  const submit = async (event) => {
    event.preventDefault();
    const token = new FormData(event.target).get('token').trim();
    const answer = await fetch('/api/session', { method: 'POST', headers: { 'Content-Type': 'application/json' }, body: JSON.stringify({ token }) });
    const content = await answer.json();
    if (!answer.ok) return setWrong(answer.status === 429 ? `${content.error}: wait ${answer.headers.get('Retry-After')} s` : content.error);
    event.target.reset();
    setWrong('');
    onDone(content);
  };
  return html`<form onSubmit=${submit} class="sign-in"><h2>Sign in</h2><p>The token is in a file on the robot; <code>shadowhound-data live</code> says where.</p>
    <input name="token" type="password" autocomplete="current-password" required autofocus aria-label="Token" aria-invalid=${Boolean(wrong)} />
    ${wrong ? html`<p class="note bad" role="alert">${wrong}</p>` : why && html`<p class="note" role="status">${why}</p>`}
    <div class="row"><button class="primary">Sign in</button>${box && html`<button type="button" onClick=${() => box.current.close()}>Cancel</button>`}</div></form>`;
}

function Head({ onSignIn }) {
  const told = figures.value;
  const isLost = connection.value !== 'connected';
  const running = told?.state === 'running';
  const [text, kind] = past.value ? ['back in time', 'watch'] : !session.value.has_live ? ['the store', 'none'] : isLost ? ['no connection: trying again', 'bad'] : !told ? ['connecting', 'none'] : running ? [told.paused ? 'paused' : 'recording', told.paused ? 'watch' : 'good']
    : [told.state === 'not_answering' ? 'the node does not answer' : 'the node is not running', 'bad'];
  const signOut = async () => {
    await fetch('/api/sign-out', { method: 'POST', headers: { 'X-CSRF-Token': session.value.csrf } });
    location.reload();
  };
  return html`<header><a class="skip" href="#data">Skip to the data</a><img src="icon.svg" alt="" width="30" height="30" /><h1 title=${session.value?.robot}>${session.value?.robot ?? 'Live'}</h1>
    <span class=${`pill ${kind}`} role="status">${text}</span>
    ${!past.value && session.value.has_live && html`<nav aria-label="Parts of this page"><a href="#now">Now</a><a href="#data">The data</a><a href="#gaps">Gaps</a></nav>`}
    <span class="spacer"></span>${told && html`<${Age} kind="figures" />`}
    ${session.value?.signed_in ? html`<button type="button" onClick=${signOut}>Sign out<span class="role"> (${session.value.role})</span></button>` : html`<button type="button" onClick=${onSignIn}>Sign in</button>`}</header>`;
}

// What a robot says may be no figures: then the rest of the page goes on.
function Guarded({ of, children }) {
  this.componentDidCatch = () => {
    this.broken = of;
    this.setState({});
  };
  return this.broken === of ? html`<p class="banner bad">The robot says what cannot be shown.</p>` : children;
}

function App() {
  const box = useRef(null);
  const who = session.value;
  const open = () => box.current?.showModal();
  const done = (content) => {
    box.current?.close();
    session.value = content;
    start();
  };
  if (who === null) return html`<main class="alone"><p class="empty">Connecting …</p></main>`;
  if (who === false) return html`<main class="alone"><div class="panel"><${SignIn} why=${link && 'Your sign-in has ended.'} onDone=${done} /></div></main>`;
  const told = figures.value;
  return html`<${Head} onSignIn=${open} />
    <main class=${past.value ? 'past' : connection.value === 'connected' || !who.has_live ? '' : 'stale'}>
      <section id="now" aria-label="Now">${problem.value && !past.value && html`<p class="banner">${problem.value}</p>`}
        <div class="views"><${Camera} /><${Cloud} /><${Plan} />
        <${Chart} title="Attitude" kind="imu" lines=${ATTITUDE} options=${{ unit: '°' }} />
        <${Chart} title="Acceleration" kind="imu" lines=${FORCE} options=${{ unit: 'm/s²' }} />
        <${Chart} title="Joints" kind="joints" lines=${null} options=${{ unit: 'rad' }} figure="joints, rad" />
        <${Chart} title="Battery" kind="battery" lines=${POWER} options=${{ unit: '%', units: ['%', 'V'], seconds: 600 }} />
        <${Chart} title="Temperature" kind="battery" lines=${HEAT} options=${{ unit: '°C', seconds: 600, digits: 0 }} /></div></section>
      ${!past.value && who.has_live && html`<section id="data" aria-label="The data"><h2>The data</h2>${told ? html`<${Guarded} of=${told}><${Cards} figures=${told} /><div class="halves"><${TopicTable} figures=${told} now=${present} />
        <div class="stack"><${Controls} session=${who} figures=${told} onSignIn=${open} /><${Findings} figures=${told} /></div></div></${Guarded}>` : html`<p class="empty">…</p>`}</section>`}
      <section id="gaps" aria-label="Gaps"><h2>What is missing</h2><${Timeline} session=${who} /></section>
    </main>
    <dialog ref=${box}><${SignIn} box=${box} onDone=${done} /></dialog>`;
}

function start() {
  if (!session.value.has_live) {
    if (!past.value) openRobot(session.value.robot);
    return;
  }
  if (link) return link.start();
  link = stats.link = new Link({ onItem, onState: (state) => { connection.value = state; if (state === 'lost') { video.lost(); check(); } else video.follow(); } });
  video = stats.video = new Video({ link, onFrame: drawVideo, onChange: rewatch });
}

// Whether the cookie is still good: its time, a sign-out elsewhere or a new token ends it. Where everybody may watch a viewer is left.
async function check() {
  const before = session.value;
  try {
    const answer = await fetch('/api/session', { signal: AbortSignal.timeout(5000) });
    const told = answer.status === 401 ? false : answer.ok ? await answer.json() : before;
    if (session.value !== before) return; // somebody signed in meanwhile
    if (JSON.stringify(told) !== JSON.stringify(before)) session.value = told;
    if (told === false) link?.stop();
  } catch { /* the link says that the robot cannot be reached, or begin asks again */ }
}

// On a bad link the page may be there and its first question lost.
async function begin() {
  for (await check(); session.value === null; await check()) await new Promise((done) => { setTimeout(done, 1000); });
  if (session.value) start();
}

render(html`<${App} />`, document.getElementById('app'));
begin();
