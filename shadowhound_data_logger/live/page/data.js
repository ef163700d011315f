// The data: topics with the ledger's figures, queue, spool, delivery, findings, and the buttons of an operator.
import { html, signal, useEffect, useRef, useState } from './vendor/preact.js';
import { Message, inspected, measured } from './message.js';
import { total, topics, useItems, useWatch } from './state.js';
import { unseen } from './losses.js';
import { digits, span, volume } from './words.js';

const COLUMNS = [
  ['rate', 'Hz', 'Messages per second: as the node counts them, or in a sample of a topic that is not logged'], ['size', 'Size', 'Bytes of the newest message, serialized; of a topic that is not logged, the mean of a sample'],
  ['age', 'Age', 'Seconds since the newest message; of a topic that is not logged, at the end of its sample'], ['received', 'Received', 'Messages that the node received since it first ran'], ['stored', 'Stored', 'Messages that are in objects, delivered or waiting'],
  ['missed', 'Missed', 'Messages that were published and did not reach the node; ~ is an estimate'],
];
const MARKS = { good: ['●', 'as it should be'], watch: ['▲', 'needs a look'], bad: ['■', 'something is wrong'], none: ['○', 'no publisher now'], idle: ['◌', 'published, and not logged'] };
const MOST_ROWS = 100;
const MOST_FINDINGS = 10;
const SEARCHED = 12; // more rows than these get a search box

function state(row, figures) {
  if (row.unavailable) return ['bad', row.unavailable];
  const isNew = unseen(row.topic) !== 0; // what somebody has seen, or what is a day old, is no alarm
  if (row.lost && isNew) return ['bad', `${row.lost} messages were rejected or dropped`];
  if ((row.missed || row.missed_estimated) && isNew) return ['watch', `${row.missed ?? row.missed_estimated} messages were missed`];
  if (row.stamps) return ['watch', row.stamps];
  if (row.publishers === 0) return ['none', MARKS.none[1]];
  if (!row.isLogged) return ['idle', MARKS.idle[1]];
  if (figures.state !== 'running') return ['watch', 'not recorded now: the node does not run'];
  if (figures.paused) return ['watch', 'not recorded now: the node is paused'];
  if (row.age_s !== null && row.age_s > 5 && !row.may_be_silent) return ['watch', `silent for ${span(row.age_s)}`];
  return ['good', MARKS.good[1]];
}

export function Mark({ kind, why }) {
  return html`<span class=${`mark ${kind}`} role="img" aria-label=${why || MARKS[kind][1]} title=${why || MARKS[kind][1]}>${MARKS[kind][0]}</span>`;
}

// The node looks once a second. What comes more often is at most a period old until it looks again; what is silent ages on.
const LOOKS_HZ = 1;
const POLL_S = 0.3; // the node may learn of a message so late
const STALE_S = 3;
function TopicAge({ row, figures, now }) {
  if (row.age_s === null || row.age_s === undefined) return '–';
  const since = (figures.age_s ?? 0) + Math.max(0, (now.value ?? figures.at) - figures.at) / 1e3;
  const goesOn = row.rate_hz >= LOOKS_HZ && row.age_s < POLL_S + 2 / row.rate_hz && since < STALE_S;
  return (goesOn ? Math.min(row.age_s, 1 / row.rate_hz) : row.age_s + since).toFixed(1);
}

// Topics that the node does not take are sampled by the page in turn while rows of the table are in view: those rows first.
const AT_ONCE = 3;
const AGAIN_MS = 20e3;
const OUT_OF_VIEW_MS = 80e3;
function useSamples(rows, figures, box) {
  const [inView, setInView] = useState(new Set());
  useEffect(() => {
    const looking = new IntersectionObserver((entries) => setInView((before) => {
      const now = new Set(before);
      for (const { target, isIntersecting } of entries) now[isIntersecting ? 'add' : 'delete'](target.dataset.row);
      return now;
    }));
    for (const row of box.current?.querySelectorAll('[data-row]') ?? []) looking.observe(row);
    return () => looking.disconnect();
  }, [rows.map(({ topic }) => topic).join()]);
  useItems('sample', (head) => {
    const { at, of, age_s: age, ...more } = head;
    measured.value = { ...measured.value, [of]: { ...more, at: age === null ? null : at - age * 1e3, sampled: at } };
  });
  const due = rows.filter((row) => row.publishers > 0 && !isCounted(row, figures) && row.topic !== inspected.value)
    .map(({ topic }) => [topic, (measured.value[topic]?.sampled ?? 0) + (inView.has(topic) ? AGAIN_MS : OUT_OF_VIEW_MS)])
    .filter(([, at]) => at <= figures.at).sort((a, b) => a[1] - b[1]).slice(0, AT_ONCE).map(([topic]) => `${topic}#?`);
  useWatch([], () => (inView.size ? due : []));
}

// Whether the node takes its messages now.
const isCounted = (row, figures) => figures.state === 'running' && row.isLogged && row.enabled !== false && typeof row.rate_hz === 'number';

// How a sample was taken, in words; empty for what is counted, or read now.
function sampling(own, figures) {
  if (!own?.sampled || own.why) return '';
  const ago = span(Math.max(0, figures.at - own.sampled) / 1e3);
  return ` (a sample of ${own.seconds} s, ${ago} ago: ${own.messages} ${own.messages === 1 ? 'message' : 'messages'}${own.latched ? '; its publisher keeps the last one for late subscribers' : ''})`;
}

function sampledRate(own) {
  if (own?.hz) return own.hz.toFixed(1);
  if (!own?.sampled || own.why) return '–';
  return own.latched && own.bytes !== null ? 'latched' : own.messages ? '< 0.5' : 'none';
}

// At the end of its sample; what sent nothing in it ages on.
function OwnAge({ own, now }) {
  if (own?.at === null || own?.at === undefined) return '–';
  const until = own.sampled && own.messages ? own.sampled : now.value ?? own.at;
  return (Math.max(0, until - own.at) / 1e3).toFixed(1);
}

// Every topic: those of the node's report, and those that are published now. Publishers are counted by this page where it reads ROS.
function allTopics(figures) {
  const told = new Map(topics.value.map(([topic, kind, type, publishers]) => [topic, { kind, type, publishers }]));
  const rows = figures.topics.map((row) => ({ ...row, isLogged: Boolean((row.sensor && row.enabled !== false) || row.received), type: row.type || told.get(row.topic)?.type || '', publishers: told.get(row.topic)?.publishers ?? row.publishers }));
  const known = new Set(rows.map((row) => row.topic));
  for (const [topic, { type, publishers }] of told) if (!known.has(topic)) rows.push({ topic, type, publishers, isLogged: false });
  // What has a publisher comes first, and of that what can be drawn, then what is logged.
  const rank = (row) => (row.publishers > 0 ? (told.get(row.topic)?.kind ? 0 : row.isLogged ? 1 : 2) : row.publishers === 0 ? 4 : 3);
  return rows.sort((a, b) => rank(a) - rank(b) || (a.topic < b.topic ? -1 : 1));
}

export function TopicTable({ figures, now }) {
  const [wanted, setWanted] = useState('');
  const [isAll, setIsAll] = useState(false);
  const box = useRef(null);
  const rows = allTopics(figures);
  const words = wanted.toLowerCase().split(/\s+/).filter(Boolean);
  const found = rows.filter(({ topic, type }) => words.every((word) => `${topic} ${type}`.toLowerCase().includes(word)));
  const shown = isAll ? found : found.slice(0, MOST_ROWS);
  const untold = total.value - topics.value.length;
  useSamples(shown, figures, box);
  if (!rows.length) return html`<div class="panel"><p class="empty">No topic has a message yet.</p></div>`;
  const cell = (row, name) => {
    const own = isCounted(row, figures) ? null : measured.value[row.topic];
    if (name === 'rate') return own ? sampledRate(own) : row.rate_hz?.toFixed(1) ?? '–';
    if (name === 'size') return volume(own?.bytes ?? row.size);
    if (name === 'age' && own) return html`<${OwnAge} own=${own} now=${now} />`;
    if (name === 'age') return html`<${TopicAge} row=${row} figures=${figures} now=${now} />`;
    if (name === 'missed' && row.missed === null && row.missed_estimated !== null) return html`~${digits(row.missed_estimated)}`;
    return digits(row[name]);
  };
  return html`<div class="panel topics-panel"><div class="panel-head"><h3 title="All topics of the robot: those that the node records, with its counts since it first ran, and others, of which this page takes samples">Topics</h3>${rows.length > SEARCHED && html`<input type="search" aria-label="Search topics and types" placeholder=${`search ${rows.length} topics`} value=${wanted} onInput=${(event) => setWanted(event.target.value)} />`}
      <span class=${`verdict ${figures.balanced ? 'good' : 'bad'}`} title="Whether, for each topic, received = stored + skipped + rejected + dropped + open">${figures.balanced === null ? '' : figures.balanced ? 'the ledger balances' : 'the ledger does not balance'}</span></div>
    <div class="scroll"><table class="topics" ref=${box}>
      <thead><tr><th title="Whether the topic is recorded without losses; each mark explains itself"><span class="visually-hidden">State</span></th><th title="A click shows the newest message">Topic</th>${COLUMNS.map(([, label, what]) => html`<th class="n" title=${what}>${label}</th>`)}</tr></thead>
      <tbody>${shown.map((row) => {
        const [kind, why] = state(row, figures);
        const isOpen = inspected.value === row.topic;
        const own = isCounted(row, figures) ? null : measured.value[row.topic];
        const sample = sampling(own, figures);
        return [html`<tr key=${row.topic} data-row=${row.topic} class=${row.publishers === 0 ? 'silent' : ''}><td><${Mark} kind=${kind} why=${why} /></td>
          <td><button type="button" class="topic" aria-expanded=${isOpen} data-inspect=${row.topic} title="Show the newest message" onClick=${() => { inspected.value = isOpen ? null : row.topic; }}><b>${row.topic}</b></button>
            <small>${row.publishers === 0 ? 'no publisher' : row.isLogged ? row.sensor || '–' : 'not logged'}${row.type && html` · <span title=${row.type}>${row.type.split('/').at(-1)}</span>`}${sample && html` · <span class="n">sampled ${span(Math.max(0, figures.at - own.sampled) / 1e3)} ago</span>`}</small>
            ${(own?.why || row.unavailable) && html`<small data-topic=${row.topic} data-field="why" title="Why its messages cannot be received here">${String(own?.why || row.unavailable)}</small>`}
            ${row.stamps && html`<small class="stamps" data-topic=${row.topic} data-field="stamps" title="How the stamps of its messages differ from the times at which they arrived">${row.stamps}</small>`}</td>
          ${COLUMNS.map(([name, , what]) => html`<td class=${`n ${name === 'missed' && (row.missed || row.missed_estimated) && unseen(row.topic) !== 0 ? 'lossy' : ''}`} data-topic=${row.topic} data-field=${name} title=${['rate', 'size', 'age'].includes(name) ? what + sample : what}>${cell(row, name)}</td>`)}</tr>`,
        isOpen && html`<tr key=${`${row.topic}#`} class="inspected"><td></td><td colspan=${COLUMNS.length + 1}><${Message} key=${row.topic} topic=${row.topic} /></td></tr>`];
      })}</tbody></table></div>
    ${found.length > shown.length && html`<button type="button" onClick=${() => setIsAll(true)}>Show all ${found.length}</button>`}
    ${!found.length && html`<p class="empty">No topic matches.</p>`}${untold > 0 && html`<p class="note">${untold} more topics are not listed: most of them have no publisher.</p>`}</div>`;
}

function Bar({ part, whole, label }) {
  const share = whole ? Math.min(1, part / whole) : 0;
  return html`<div class="bar" role="meter" aria-valuenow=${Math.round(share * 100)} aria-valuemin="0" aria-valuemax="100" aria-label=${label} title=${label}>
    <i class=${share > 0.9 ? 'bad' : share > 0.7 ? 'watch' : ''} style=${{ width: `${share * 100}%` }}></i></div>`;
}

// A name with its figure; both have the definition as a tooltip.
const Row = ({ name, what, field, children }) => html`<dt title=${what}>${name}</dt><dd title=${what} data-field=${field}>${children}</dd>`;

// When all that waits will be there, in words.
function arrival(waiting, store) {
  if (waiting === 0) return 'nothing waits';
  if (store?.left_s !== null && store?.left_s !== undefined) return store.left_s < 1 ? 'less than a second' : span(store.left_s);
  if (Object.keys(store?.waits_for ?? {}).length) return 'once a rule holds';
  return { idle: 'about to be sent', shipping: 'not known yet', store_down: 'once the store can be reached', paused: 'once the error is corrected', not_draining: 'another process sends it' }[store?.state] ?? 'once the node runs';
}

const DELIVERY = { idle: 'nothing to send', shipping: 'sending', store_down: 'the store is unreachable', paused: 'stopped by an error', not_draining: 'another process sends', waiting: 'waiting for a rule' };

export function Cards({ figures }) {
  const { queue, spool, store, objects } = figures;
  const waiting = spool?.pending ?? objects?.pending ?? 0;
  const bytes = waiting ? figures.bytes?.pending : 0;
  const rules = Object.entries(store?.waits_for ?? {});
  const storeState = store?.state ? DELIVERY[store.state] ?? store.state.replaceAll('_', ' ') : 'no node runs';
  const isFine = ['idle', 'shipping', 'not_draining', 'waiting'].includes(store?.state);
  const sending = store?.mbps ? html`${store.mbps.toFixed(1)} Mbit/s${store.max_mbps ? html` <small>of at most ${store.max_mbps}</small>` : ''}` : 'nothing now';
  return html`<div class="cards">
    <div class="panel card"><h3 title="How objects are uploaded from the robot’s disk to the S3 store">Delivery to the store</h3><p class="big" data-field="store" title="What the node does with objects that are ready: sending, waiting for a rule, or trying again"><${Mark} kind=${isFine ? 'good' : store?.state ? 'bad' : 'none'} why=${storeState} /> ${storeState}</p>
      <dl><${Row} name="to" field="target" what="The store that objects are sent to">${store?.target || '–'}</${Row}><${Row} name="sends" field="mbps" what="The rate of uploads now, and its limit">${sending}</${Row}>
      <${Row} name="delivered" what="Objects that the store has confirmed since the node first ran"><span data-field="delivered">${digits(objects?.delivered)}</span> objects</${Row}></dl>${store?.last_error && !isFine ? html`<p class="note bad">${store.last_error}</p>` : ''}${rules.map(([name, why]) => html`<p class="note watch" data-field="waits-for" title=${`The setting ${name} delays uploads`}>waits for ${why}</p>`)}</div>
    <div class="panel card"><h3 title="Data that was recorded and is only on the robot’s disk until the store has confirmed it">Waiting for delivery</h3><p class="big" data-field="waiting" title="Objects on the robot’s disk that the store does not have yet">${digits(waiting)} <small>objects</small></p>
      <dl><${Row} name="size" field="waiting-bytes" what="The bytes of the objects that wait">${volume(bytes)}</${Row}><${Row} name="delivered in" field="left" what="When all of them will be in the store, at the rate of the last seconds">${arrival(waiting, store)}</${Row}>
      <${Row} name="oldest" field="oldest" what="How long the oldest of them has been waiting">${spool?.oldest_age_s ? span(spool.oldest_age_s) : '–'}</${Row}></dl></div>
    <div class="panel card"><h3 title="The folder on the robot to which each object is written before it is sent">Robot’s disk (spool)</h3><p class="big" data-field="spool-bytes" title="Bytes of all objects on the robot’s disk: those that wait, and those that are kept">${volume(spool?.bytes)}</p>
      <${Bar} part=${spool?.bytes ?? 0} whole=${spool?.max_bytes} label="How full the spool is" />
      <dl><${Row} name="limit" field="spool-limit" what="spool.max_bytes: when it is reached, the least important objects are deleted, and the ledger lists them">${volume(spool?.max_bytes)}</${Row}><${Row} name="disk has free" field="free" what="Free space on the disk that the spool is on">${volume(spool?.free_bytes)}</${Row}><${Row} name="in quarantine" field="quarantined" what="Objects that the store refused; they stay on the robot, with the reason: shadowhound-data spool list">${digits(spool?.quarantined)}</${Row}></dl></div>
    <div class="panel card"><h3 title="Messages between their arrival and the disk; what is in memory is lost if the node crashes">Memory (queue)</h3><p class="big" data-field="queue" title="Messages in memory that are not encoded and not on the disk yet">${digits(queue?.messages)} <small>messages</small></p>
      <${Bar} part=${queue?.messages ?? 0} whole=${queue?.max_messages} label="How full the queue is" />
      <dl><${Row} name="size" field="queue-bytes" what="The bytes of these messages">${volume(queue?.bytes)}</${Row}><${Row} name="mission" field="mission" what="The mission that is running">${figures.mission?.mission_id || figures.mission?.active?.mission_id || 'none'}</${Row}>${figures.mission?.policy ? html`<${Row} name="policy" field="policy" what="The policy that this mission runs">${figures.mission.policy}</${Row}>` : ''}<${Row} name="bag" field="bag" what="The bag that is being recorded">${figures.bag?.name || figures.bag?.bag || figures.bag?.state || 'none'}</${Row}></dl></div>
  </div>`;
}

export const doctor = signal({ state: 'idle', results: [], error: '' });

async function examine() {
  doctor.value = { ...doctor.value, state: 'asking', error: '' };
  try {
    const answer = await fetch('/api/doctor');
    const content = await answer.json();
    const found = content.doctor ?? {};
    const results = found.results ?? [];
    doctor.value = { state: 'told', results, error: content.error ?? '' };
  } catch {
    doctor.value = { state: 'told', results: [], error: 'the robot cannot be reached' };
  }
}

// A check that did not end in time has found nothing, neither good nor bad.
const isLate = ({ check }) => String(check).endsWith('.deadline');

export function Findings({ figures }) {
  const [isAll, setIsAll] = useState(false);
  const { state: asked, results, error } = doctor.value;
  const wrong = results.filter((each) => ['warning', 'error'].includes(each.severity));
  return html`<div class="panel"><div class="panel-head"><h3 title="What needs attention, as the node reports it, and what the doctor finds">Findings</h3><button type="button" title="Checks the robot, its node, its network and its store; takes up to a minute" onClick=${examine} disabled=${asked === 'asking'}>${asked === 'asking' ? 'The doctor is checking…' : 'Run the doctor'}</button></div>
    ${figures.findings.length ? html`<ul class="findings">${figures.findings.slice(0, isAll ? undefined : MOST_FINDINGS).map((text) => html`<li><${Mark} kind="watch" why="finding" /><span>${text}</span></li>`)}</ul>${!isAll && figures.findings.length > MOST_FINDINGS && html`<button type="button" onClick=${() => setIsAll(true)}>Show all ${figures.findings.length}</button>`}`
      : html`<p class="empty good">Nothing needs attention.</p>`}
    ${asked === 'told' && html`<div class="doctor" aria-live="polite"><h4 title="The result of the checks that were started here">The doctor</h4>
      ${error ? html`<p class="note bad">${error}</p>` : !wrong.length ? html`<p class="good">${results.length} checks, no problem found.</p>`
      : html`<ul class="findings">${wrong.map((each) => html`<li><${Mark} kind=${each.severity === 'error' && !isLate(each) ? 'bad' : 'watch'} why=${isLate(each) ? 'not known: the check did not end in time' : each.severity} />
        <span><b>${isLate(each) ? `Not known (${each.check.split('.')[0]}): ${each.seen}` : each.seen}</b>${each.cause ? html`<br />${each.cause}` : ''}${each.remedy ? html`<br /><code>${each.remedy}</code>` : ''}</span></li>`)}</ul>`}</div>`}
  </div>`;
}

const answers = signal([]);
const busy = signal('');

// Ask the node for something; its answer is listed.
async function act(session, do_, more = {}) {
  busy.value = do_;
  let said = { ok: false, error: 'the robot cannot be reached' };
  try {
    const answer = await fetch('/api/act', { method: 'POST', headers: { 'Content-Type': 'application/json', 'X-CSRF-Token': session.csrf }, body: JSON.stringify({ do: do_, ...more }) });
    said = await answer.json();
  } catch { /* said already */ }
  answers.value = [{ at: new Date().toISOString().slice(11, 19), do: do_, ok: said.ok === true, text: said.message ?? said.error ?? '' }, ...answers.value].slice(0, 6);
  busy.value = '';
}

// On a phone, first of all: the state in a line, and the button that matters most.
export function Glance({ session, figures, onSignIn }) {
  const { spool, store } = figures;
  const waiting = spool?.pending ?? 0;
  const findings = figures.findings.length;
  const last = answers.value[0];
  const save = () => (session.role === 'operator' ? act(session, 'event', { name: 'manual' }) : onSignIn());
  return html`<div class="glance"><button type="button" class="primary" disabled=${Boolean(busy.value)} onClick=${save} data-glance="save" title="Keeps what the robot recorded around this moment, at its full rate">Save this moment</button>
    <span title="Objects on the robot’s disk that the store does not have yet"><b>${digits(waiting)}</b> waiting</span>${waiting > 0 && html`<span title="When all of them will be in the store">${store?.left_s === null || store?.left_s === undefined ? '' : 'delivered in '}${arrival(waiting, store)}</span>`}<a title="What needs attention" href="#data" class=${findings ? 'watch' : 'good'}>${findings ? `${findings} ${findings === 1 ? 'finding' : 'findings'}` : 'no findings'}</a>
    ${last && html`<small class=${last.ok ? '' : 'bad'} role="status">${last.text}</small>`}</div>`;
}

const ACTS = {
  'bag start': 'Record all topics of the settings into a bag, until you stop it', 'bag split': 'Close this file of the bag and continue in a new one', 'bag stop': 'End the bag; its files are uploaded',
  flush: 'Close the batches that are open now, so that their objects are sent', pause: 'Stop storing messages; they are counted as lost (paused)', resume: 'Store messages again',
};

export function Controls({ session, figures, onSignIn }) {
  const [name, setName] = useState('');
  const [note, setNote] = useState('');
  if (session.role !== 'operator') {
    return html`<div class="panel controls"><div class="panel-head"><h3 title="Commands to the node; only an operator may give them">Missions, bags, events</h3></div><p class="empty">You can watch. To trigger events and record bags, sign in with the operator’s token.</p>
      <button type="button" class="primary" onClick=${onSignIn}>Sign in as operator</button></div>`;
  }
  const button = (do_, label, kind = '') => html`<button type="button" class=${kind} disabled=${Boolean(busy.value)} onClick=${() => act(session, do_)} data-act=${do_} title=${ACTS[do_]}>${busy.value === do_ ? '…' : label}</button>`;
  return html`<div class="panel controls"><div class="panel-head"><h3 title="Commands to the node; the ledger records who gave them">Missions, bags, events</h3><span class="unit">you are an operator</span></div>
    <form class="row" onSubmit=${(event) => { event.preventDefault(); act(session, 'event', { name: name || 'manual', ...(note ? { note } : {}) }); }}>
      <input aria-label="Name of the event" placeholder="what happened" maxlength="100" value=${name} onInput=${(event) => setName(event.target.value)} />
      <input aria-label="Note" placeholder="a note" maxlength="1000" value=${note} onInput=${(event) => setNote(event.target.value)} />
      <button class="primary" disabled=${Boolean(busy.value)} data-act="event" title="Keeps what the robot recorded around this moment, at its full rate">${busy.value === 'event' ? '…' : 'Save this moment'}</button></form>
    <div class="row"><span class="row-name" title="A recording of all messages of some topics, as MCAP files">Bag</span>${button('bag start', 'Start')}${button('bag split', 'Split')}${button('bag stop', 'Stop')}</div>
    <div class="row"><span class="row-name" title="The program that records on the robot">Node</span>${button('flush', 'Flush')}${figures.paused ? button('resume', 'Resume', 'primary') : button('pause', 'Pause')}</div>
    <ol class="answers" aria-live="polite">${answers.value.map((each) => html`<li class=${each.ok ? '' : 'bad'}><time>${each.at}</time> <b>${each.do}</b> ${each.text}</li>`)}</ol></div>`;
}
