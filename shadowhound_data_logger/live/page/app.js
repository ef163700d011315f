// The live page: what the robot sees now, its data, and what is missing.
import { batch, html, render, signal, useRef, useState } from './vendor/preact.js';
import { Cards, Controls, Findings, Glance, TopicTable } from './data.js';
import { Link } from './link.js';
import { fromAddress, toAddress } from './moments.js';
import { Age, Views, noteScale, transforms } from './panels.js';
import { openRobot, past, show } from './past.js';
import { Plot } from './plots.js';
import { prefill } from './prefill.js';
import {
  chosen, connection, figures, give, layout, loadLayout, pastRings, present, problem, rewatch, ringOf, rings, seen, session, shared, tellProblem, topics, total, views,
} from './state.js';
import { Timeline } from './timeline.js';
import { Video } from './video.js';

// For whoever measures: how late items were when they came and when they were drawn, ms.
const stats = (window.shadowhound = {
  came: {}, drawn: {}, count: {}, wrong: 0, link: null, robot: () => transforms.robot(), view: () => views.cloud?.camera.position.toArray(),
  ages: () => Object.fromEntries([...seen].map(([kind, { at }]) => [kind, stats.link.now() - at])), at: () => Object.fromEntries([...seen].map(([kind, { at }]) => [kind, at])),
});
Plot.rings = ringOf;
const newest = new Map(); // of kinds that are drawn in space, for a view that is loaded later
views.late = { [Symbol.iterator]: () => newest.values() };
setInterval(() => { if (!document.hidden) present.value = shared.link?.now() ?? null; }, 100);

function note(where, kind, at) {
  const now = shared.link?.now() ?? null;
  if (now !== null && !past.value) (where[kind] ??= []).push(now - at);
  if (where[kind]?.length > 4000) where[kind].splice(0, 2000);
}

const drawn = (head) => {
  note(stats.drawn, 'camera', head.at);
  stats.first ??= performance.now();
};

function drawVideo(element, at) {
  if (past.value || !views.camera) return;
  note(stats.came, 'camera', at);
  seen.set('camera', { at });
  stats.count.camera = (stats.count.camera ?? 0) + 1;
  views.camera.draw(element, element.videoWidth, element.videoHeight);
  note(stats.drawn, 'camera', at);
}

const SOON_MS = 5000; // until the page of a store looks whether it is a robot's now
const IN_SPACE = ['cloud', 'scan', 'map', 'model'];
const MOST_CELLS = 512 * 512;

// The cells of a map are deflated; no more of them are unpacked than it says.
async function unpacked(body, size) {
  const reader = new Blob([body]).stream().pipeThrough(new DecompressionStream('deflate')).getReader();
  const cells = new Uint8Array(size);
  for (let at = 0; at < size;) {
    const { done, value } = await reader.read();
    if (done || at + value.length > size) throw new Error('its size is wrong');
    cells.set(value, at);
    at += value.length;
  }
  reader.cancel();
  return cells;
}

async function inSpace(head, body) {
  const { kind } = head;
  if (kind === 'map') {
    if (!(head.width > 0 && head.height > 0 && head.width * head.height <= MOST_CELLS)) throw new Error('no map');
    body = await unpacked(body, head.width * head.height);
    views.plan?.map(head, body);
  }
  newest.set(kind, [head, body]);
  views.cloud?.take(head, body, () => note(stats.drawn, kind, head.at));
  if (kind === 'cloud') views.plan?.cloud(head, body);
  if (kind === 'scan') views.plan?.scan(head, body);
}

function onItem(head, body) {
  try {
    take(head, body)?.catch(() => { stats.wrong += 1; });
  } catch (error) {
    stats.wrong += 1; // a robot may say what cannot be shown: then the rest of the page continues
    stats.error = String(error);
  }
}

function take(head, body) {
  const { kind } = head;
  if (kind === 'video') return void shared.video.take(head);
  if (past.value && kind !== 'topics' && kind !== 'figures') return; // on its way when somebody looked back
  stats.count[kind] = (stats.count[kind] ?? 0) + 1;
  const isChosen = !head.topic || head.topic === chosen(kind) || kind === 'tf';
  if (head.at !== undefined && isChosen) {
    seen.set(kind, { at: head.at });
    note(stats.came, kind, head.at);
  }
  if (kind === 'topics') {
    batch(() => {
      topics.value = head.topics;
      total.value = head.total;
      problem.value = head.problem;
    });
    rewatch();
  } else if (kind === 'figures') {
    figures.value = { ...head.figures, at: head.at };
    document.title = `${head.figures.robot ?? 'No robot'} · live`;
    rewatch();
  } else if (kind === 'problem') {
    tellProblem(head);
  } else if (kind === 'tf') {
    transforms.add(head, body);
    if (views.plan?.follow()) views.cloud?.trail(views.plan.path);
    views.cloud?.take(head, body);
  } else if (kind === 'camera') {
    noteScale(head);
    if (isChosen) views.camera?.show(head, body);
  } else if (!isChosen) {
    // a panel of its own has it
  } else if (IN_SPACE.includes(kind)) {
    return inSpace(head, body);
  } else if (rings[kind]) {
    rings[kind].add(head, body);
    if (kind === 'joints') views.cloud?.joints(rings.joints.last());
    if (kind === 'odom') {
      const pose = rings.odom.last();
      views.cloud?.pose(pose);
      if (views.plan?.pose(pose)) views.cloud?.trail(views.plan.path);
    }
  }
  give(head, body);
}

// What a moment has for the floor plan, which may be loaded later than the moment.
let ofMoment = [];
views.onPlan = () => {
  if (!past.value || !views.plan) return;
  for (const [item, body] of ofMoment) {
    if (item.kind === 'path') views.plan.trail(poses(item, body));
    else if (item.kind === 'cloud' && item.topic === chosen('cloud')) views.plan.cloud(item, body, true);
  }
  if (pastRings.odom.names.length) views.plan.pose(pastRings.odom.last());
};

const poses = ({ points }, body) => {
  const view = new DataView(body.buffer);
  return Array.from({ length: points }, (_, row) => [0, 1, 2].map((place) => view.getFloat32((row * 3 + place) * 4, true)));
};

// Of a moment that is past, all there is of it, at once.
show((head, items) => {
  rewatch();
  for (const ring of Object.values(pastRings)) ring.clear();
  for (const [item, body] of items) {
    const { kind, topic } = item;
    if (kind === 'path') {
      views.cloud?.trail(poses(item, body));
    } else if (topic !== chosen(kind)) {
      // another topic of the kind is shown
    } else if (kind === 'camera') {
      noteScale(item);
      views.camera?.show(item, body);
    } else if (kind === 'cloud') {
      newest.set(kind, [item, body]);
      views.cloud?.take(item, body);
    } else if (pastRings[kind]) {
      pastRings[kind].add(item, body);
      if (kind === 'joints') views.cloud?.joints(pastRings.joints.last());
      if (kind === 'odom') views.cloud?.pose(pastRings.odom.last());
    }
  }
  ofMoment = items;
  views.onPlan();
  stats.past = { at: head.at, shown: head.shown, count: (stats.past?.count ?? 0) + 1 };
});
let wasPast = false;
past.subscribe((now) => {
  toAddress(now);
  if (Boolean(now) === wasPast) return;
  wasPast = Boolean(now);
  newest.clear();
  transforms.clear();
  views.plan?.clear();
  views.cloud?.trail([]);
  rewatch();
});
layout.subscribe(() => rewatch());

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
  const [text, kind, what] = past.value ? ['back in time', 'watch', 'The page shows a moment of the past'] : !session.value.has_live ? ['the store', 'none', 'The page shows what robots have delivered to a store']
    : isLost ? ['no connection: trying again', 'bad', 'The robot’s page cannot be reached: what is shown was received before'] : !told ? ['connecting', 'none', 'Nothing has been received yet']
    : running ? (told.paused ? ['paused', 'watch', 'The node runs and stores nothing until an operator resumes it'] : ['recording', 'good', 'The node runs and stores messages as its settings say'])
    : [told.state === 'not_answering' ? 'the node does not answer' : 'the node is not running', 'bad', 'The node, which stores the messages, writes a status once per second: it did not in the last five seconds'];
  const signOut = async () => {
    await fetch('/api/sign-out', { method: 'POST', headers: { 'X-CSRF-Token': session.value.csrf } });
    location.reload();
  };
  return html`<header><a class="skip" href="#data">Skip to the data</a><img src="icon.svg" alt="" width="30" height="30" /><h1 title=${session.value?.robot}>${session.value?.robot || 'Live'}</h1>
    <span class=${`pill ${kind}`} role="status" title=${what}>${text}</span>
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

// On a touch screen a tap on a figure shows its definition, as a mouse does over it.
const hint = signal('');
const noHover = matchMedia('(hover: none)');
document.addEventListener('click', (event) => {
  const of = noHover.matches && !event.target.closest('button, a, input, select, summary') && event.target.closest('[title]');
  hint.value = of && of.title !== hint.value ? of.title : '';
});

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
  if (who === false) return html`<main class="alone"><div class="panel"><${SignIn} why=${shared.link && 'Your sign-in has ended.'} onDone=${done} /></div></main>`;
  const told = figures.value;
  return html`<${Head} onSignIn=${open} />
    <main class=${past.value ? 'past' : connection.value === 'connected' || !who.has_live ? '' : 'stale'}>
      <section id="now" aria-label="Now">${who.waits && (!past.value || !who.has_live) && html`<p class="banner" data-waits>${who.waits}</p>`}${problem.value && !past.value && html`<p class="banner">${problem.value}</p>`}
        ${!past.value && who.has_live && told && html`<${Glance} session=${who} figures=${told} onSignIn=${open} />`}<${Views} drawn=${drawn} /></section>
      ${!past.value && who.has_live && html`<section id="data" aria-label="The data"><h2 title="The topics of the robot, what the node records of them, and how much of it has reached the store">The data</h2>${told ? html`<${Guarded} of=${told}><${Cards} figures=${told} /><div class="halves"><${TopicTable} figures=${told} now=${present} session=${who} />
        <div class="stack"><${Controls} session=${who} figures=${told} onSignIn=${open} /><${Findings} figures=${told} /></div></div></${Guarded}>` : html`<p class="empty">…</p>`}</section>`}
      <section id="gaps" aria-label="Gaps"><h2 title="Messages that were published and will not be in the store, with the time and the cause">What is missing</h2><${Timeline} session=${who} /></section>
    </main>
    ${hint.value && html`<p class="hint" role="status">${hint.value}</p>`}
    <dialog ref=${box}><${SignIn} box=${box} onDone=${done} /></dialog>`;
}

async function start() {
  loadLayout();
  const isThere = past.value !== null || await fromAddress();
  if (!session.value.has_live) {
    if (!isThere) openRobot(session.value.robot);
    return;
  }
  if (shared.link) return shared.link.start();
  const link = (shared.link = stats.link = new Link({ onItem, onState: (state) => { connection.value = state; if (state === 'lost') { video.lost(); check(); } else video.follow(); } }));
  const video = (shared.video = stats.video = new Video({ link, onFrame: drawVideo, onChange: rewatch }));
  prefill({ rings, chosen, plan: () => views.plan, onPath: (path) => views.cloud?.trail(path) });
}

// Whether the cookie is still good: its time, a sign-out elsewhere or a new token ends it. Where everybody may watch a viewer is left.
async function check() {
  const before = session.value;
  try {
    const answer = await fetch('/api/session', { signal: AbortSignal.timeout(5000) });
    const told = answer.status === 401 ? false : answer.ok ? await answer.json() : before;
    if (session.value !== before) return; // somebody signed in meanwhile
    if (before && told && (told.has_live !== before.has_live || told.robot !== before.robot || told.waits !== before.waits)) {
      history.replaceState(null, '', location.pathname); // it is another page now
      return location.reload();
    }
    if (JSON.stringify(told) !== JSON.stringify(before)) session.value = told;
    if (told === false) shared.link?.stop();
  } catch { /* the link says that the robot cannot be reached, or begin asks again */ }
}

// On a bad link the page may be there and its first question lost.
async function begin() {
  for (await check(); session.value === null; await check()) await new Promise((done) => { setTimeout(done, 1000); });
  if (session.value) start();
  setInterval(() => session.value && !session.value.has_live && !document.hidden && check(), SOON_MS);
}

render(html`<${App} />`, document.getElementById('app'));
begin();
