// The data: topics with the ledger's figures, queue, spool, delivery, findings, and the buttons of an operator.
import { html, signal, useState } from './vendor/preact.js';
import { digits, span, volume } from './words.js';

const COLUMNS = [['rate', 'Hz'], ['received', 'Received'], ['stored', 'Stored'], ['missed', 'Missed'], ['age', 'Age']];
const MARKS = { good: ['●', 'as it should be'], watch: ['▲', 'needs a look'], bad: ['■', 'something is wrong'], none: ['○', 'nothing is published'] };

function state(row) {
  if (row.unavailable) return ['bad', row.unavailable];
  if (row.lost) return ['bad', `${row.lost} messages were rejected or dropped`];
  if (row.missed || row.missed_estimated) return ['watch', `${row.missed ?? row.missed_estimated} messages were missed`];
  if (row.stamps) return ['watch', row.stamps];
  if (row.publishers === 0) return ['none', 'nobody publishes it now'];
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

export function TopicTable({ figures, now }) {
  const rows = figures.topics;
  if (!rows.length) return html`<div class="panel"><p class="empty">No topic has been heard yet.</p></div>`;
  const cell = (row, name) => {
    if (name === 'rate') return row.rate_hz === null || row.rate_hz === undefined ? '–' : row.rate_hz.toFixed(1);
    if (name === 'age') return html`<${TopicAge} row=${row} figures=${figures} now=${now} />`;
    if (name === 'missed' && row.missed === null && row.missed_estimated !== null) return html`~${digits(row.missed_estimated)}`;
    return digits(row[name]);
  };
  return html`<div class="panel"><div class="panel-head"><h3>Topics</h3>
      <span class=${`verdict ${figures.balanced ? 'good' : 'bad'}`}>${figures.balanced === null ? '' : figures.balanced ? 'the ledger balances' : 'the ledger does not balance'}</span></div>
    <div class="scroll"><table class="topics">
      <thead><tr><th><span class="visually-hidden">State</span></th><th>Topic</th>${COLUMNS.map(([, label]) => html`<th class="n">${label}</th>`)}</tr></thead>
      <tbody>${rows.map((row) => {
        const [kind, why] = state(row);
        return html`<tr key=${row.topic}><td><${Mark} kind=${kind} why=${why} /></td>
          <td><b>${row.topic}</b><small>${row.sensor || '–'} · ${row.type.split('/').at(-1)}</small>
            ${row.stamps && html`<small class="stamps" data-topic=${row.topic} data-field="stamps">${row.stamps}</small>`}</td>
          ${COLUMNS.map(([name]) => html`<td class=${`n ${name === 'missed' && (row.missed || row.missed_estimated) ? 'lossy' : ''}`} data-topic=${row.topic} data-field=${name}>${cell(row, name)}</td>`)}</tr>`;
      })}</tbody></table></div></div>`;
}

function Bar({ part, whole, label }) {
  const share = whole ? Math.min(1, part / whole) : 0;
  return html`<div class="bar" role="meter" aria-valuenow=${Math.round(share * 100)} aria-valuemin="0" aria-valuemax="100" aria-label=${label}>
    <i class=${share > 0.9 ? 'bad' : share > 0.7 ? 'watch' : ''} style=${{ width: `${share * 100}%` }}></i></div>`;
}

export function Cards({ figures }) {
  const { queue, spool, store, objects } = figures;
  const waiting = spool?.pending ?? objects?.pending ?? 0;
  const bytes = figures.bytes?.pending ?? 0;
  const rules = Object.entries(store?.waits_for ?? {});
  const left = store?.left_s ?? null;
  const storeState = store?.state ? store.state.replaceAll('_', ' ') : 'no node runs';
  const isFine = ['idle', 'shipping', 'not_draining', 'waiting'].includes(store?.state);
  return html`<div class="cards">
    <div class="panel card"><h3>Delivery</h3><p class="big"><${Mark} kind=${isFine ? 'good' : store?.state ? 'bad' : 'none'} why=${storeState} /> ${storeState}</p>
      <dl><dt>to</dt><dd>${store?.target || '–'}</dd><dt>sends</dt><dd>${store?.mbps ? `${store.mbps.toFixed(1)} Mbit/s` : 'nothing now'}${store?.max_mbps ? html` <small>of at most ${store.max_mbps}</small>` : ''}</dd>
      <dt>delivered</dt><dd><span data-field="delivered">${digits(objects?.delivered)}</span> objects</dd></dl>${store?.last_error && !isFine ? html`<p class="note bad">${store.last_error}</p>` : ''}${rules.map(([name, why]) => html`<p class="note watch" data-field="waits-for" title=${name}>waits for ${why}</p>`)}</div>
    <div class="panel card"><h3>Waiting</h3><p class="big">${digits(waiting)} <small>objects</small></p>
      <dl><dt>size</dt><dd>${volume(bytes)}</dd><dt>there in</dt><dd data-field="left">${waiting === 0 ? 'nothing waits' : left !== null ? span(left) : rules.length ? 'once a rule holds' : 'not at today’s pace'}</dd>
      <dt>oldest</dt><dd>${spool?.oldest_age_s ? span(spool.oldest_age_s) : '–'}</dd></dl></div>
    <div class="panel card"><h3>Spool</h3><p class="big">${volume(spool?.bytes)}</p>
      <${Bar} part=${spool?.bytes ?? 0} whole=${spool?.max_bytes} label="how full the spool is" />
      <dl><dt>of at most</dt><dd>${volume(spool?.max_bytes)}</dd><dt>disk has free</dt><dd>${volume(spool?.free_bytes)}</dd><dt>quarantined</dt><dd>${digits(spool?.quarantined)}</dd></dl></div>
    <div class="panel card"><h3>Queue</h3><p class="big">${digits(queue?.messages)} <small>messages</small></p>
      <${Bar} part=${queue?.messages ?? 0} whole=${queue?.max_messages} label="how full the queue is" />
      <dl><dt>in memory</dt><dd>${volume(queue?.bytes)}</dd><dt>mission</dt><dd>${figures.mission?.mission_id || figures.mission?.active?.mission_id || 'none'}</dd>${figures.mission?.policy ? html`<dt>policy</dt><dd data-field="policy">${figures.mission.policy}</dd>` : ''}<dt>bag</dt><dd>${figures.bag?.name || figures.bag?.bag || figures.bag?.state || 'none'}</dd></dl></div>
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

export function Findings({ figures }) {
  const { state: asked, results, error } = doctor.value;
  const wrong = results.filter((each) => ['warning', 'error'].includes(each.severity));
  return html`<div class="panel"><div class="panel-head"><h3>Findings</h3><button type="button" onClick=${examine} disabled=${asked === 'asking'}>${asked === 'asking' ? 'The doctor looks…' : 'Ask the doctor'}</button></div>
    ${figures.findings.length ? html`<ul class="findings">${figures.findings.map((text) => html`<li><${Mark} kind="watch" why="finding" /><span>${text}</span></li>`)}</ul>`
      : html`<p class="empty good">The node has nothing to complain about.</p>`}
    ${asked === 'told' && html`<div class="doctor" aria-live="polite"><h4>The doctor</h4>
      ${error ? html`<p class="note bad">${error}</p>` : !wrong.length ? html`<p class="good">${results.length} checks, nothing is wrong.</p>`
      : html`<ul class="findings">${wrong.map((each) => html`<li><${Mark} kind=${each.severity === 'error' ? 'bad' : 'watch'} why=${each.severity} />
        <span><b>${each.seen}</b>${each.cause ? html`<br />${each.cause}` : ''}${each.remedy ? html`<br /><code>${each.remedy}</code>` : ''}</span></li>`)}</ul>`}</div>`}
  </div>`;
}

const answers = signal([]);

export function Controls({ session, figures, onSignIn }) {
  const [name, setName] = useState('');
  const [note, setNote] = useState('');
  const [busy, setBusy] = useState('');
  const act = async (do_, more = {}) => {
    setBusy(do_);
    let said = { ok: false, error: 'the robot cannot be reached' };
    try {
      const answer = await fetch('/api/act', { method: 'POST', headers: { 'Content-Type': 'application/json', 'X-CSRF-Token': session.csrf }, body: JSON.stringify({ do: do_, ...more }) });
      said = await answer.json();
    } catch { /* said already */ }
    answers.value = [{ at: new Date().toISOString().slice(11, 19), do: do_, ok: said.ok === true, text: said.message ?? said.error ?? '' }, ...answers.value].slice(0, 6);
    setBusy('');
  };
  if (session.role !== 'operator') {
    return html`<div class="panel controls"><div class="panel-head"><h3>Missions, bags, events</h3></div><p class="empty">You may watch. To trigger events and record bags, sign in with the operator’s token.</p>
      <button type="button" class="primary" onClick=${onSignIn}>Sign in as operator</button></div>`;
  }
  const button = (do_, label, kind = '') => html`<button type="button" class=${kind} disabled=${Boolean(busy)} onClick=${() => act(do_)} data-act=${do_}>${busy === do_ ? '…' : label}</button>`;
  return html`<div class="panel controls"><div class="panel-head"><h3>Missions, bags, events</h3><span class="unit">you are an operator</span></div>
    <form class="row" onSubmit=${(event) => { event.preventDefault(); act('event', { name: name || 'manual', ...(note ? { note } : {}) }); }}>
      <input aria-label="Name of the event" placeholder="what happened" maxlength="100" value=${name} onInput=${(event) => setName(event.target.value)} />
      <input aria-label="Note" placeholder="a note" maxlength="1000" value=${note} onInput=${(event) => setNote(event.target.value)} />
      <button class="primary" disabled=${Boolean(busy)} data-act="event">${busy === 'event' ? '…' : 'Save this moment'}</button></form>
    <div class="row"><span class="row-name">Bag</span>${button('bag start', 'Begin')}${button('bag split', 'Split')}${button('bag stop', 'End')}</div>
    <div class="row"><span class="row-name">Node</span>${button('flush', 'Flush')}${figures.paused ? button('resume', 'Resume', 'primary') : button('pause', 'Pause')}</div>
    <ol class="answers" aria-live="polite">${answers.value.map((each) => html`<li class=${each.ok ? '' : 'bad'}><time>${each.at}</time> <b>${each.do}</b> ${each.text}</li>`)}</ol></div>`;
}
