// What the robot keeps until somebody asks for it: how much that is of a time, asking for it, and what became of requests.
import { html, useEffect, useState } from './vendor/preact.js';
import { past } from './past.js';
import { clock, digits, moment, span, volume } from './words.js';

const EVERY_MS = 5000;
const PAUSE_MS = 400;
const AROUND_MS = 5000; // of the moment, where no time is selected
const OPEN = ['asked', 'accepted', 'sending', 'active'];

async function read(what, more) {
  const answer = await fetch(`/api/past/${what}?${new URLSearchParams(more)}`);
  const content = await answer.json();
  if (!answer.ok) throw new Error(content.error);
  return content;
}

function Request({ each, mbps, mayCancel, cancel }) {
  const left = Math.max(0, each.bytes - each.sent_bytes);
  const isOpen = OPEN.includes(each.state);
  const time = each.from === undefined ? '' : `${moment(each.from)} for ${span((each.to - each.from) / 1000)}`;
  return html`<li class=${['refused', 'expired'].includes(each.state) ? 'bad' : ''} data-request=${each.id} data-state=${each.state}><b>${each.state === 'active' ? 'sending' : each.state}</b> ${each.sensor} ${time}
    ${each.state !== 'asked' && html`: <span data-field="sent" title="Objects that were sent so far">${digits(each.sent)}</span> of ${digits(each.objects)} objects, ${volume(each.sent_bytes)} of ${volume(each.bytes)}`}
    ${isOpen && left > 0 && mbps ? `, the rest in ${span((left * 8e-6) / mbps)}` : ''}${each.why ? `: ${each.why}` : ''} <span class="unit">by ${each.by}</span>
    ${isOpen && mayCancel && html` <button type="button" onClick=${() => cancel(each.id)}>Cancel</button>`}</li>`;
}

export function Pull({ session, robot, selected }) {
  const [kept, setKept] = useState({});
  const [asked, setAsked] = useState({ requests: [], mbps: null });
  const [sensor, setSensor] = useState('');
  const [said, setSaid] = useState(['', '']);
  const [rounds, again] = useState(0);
  const [mine, setMine] = useState(null); // was asked for here, and may not be listed yet
  const at = Math.round(past.value.at);
  const [from, to] = selected ? [Math.round(selected[0]), Math.round(selected[1]) + 1] : [at - AROUND_MS, at + AROUND_MS];
  const mayAct = session.role === 'operator';

  useEffect(() => {
    let isOver = false;
    const load = () => !document.hidden && read('kept', { robot, from, to }).then((content) => !isOver && setKept(content.kept), () => !isOver && setKept({}));
    const first = setTimeout(load, PAUSE_MS);
    const timer = setInterval(load, 3 * EVERY_MS); // what was sent is not kept any more
    return () => {
      isOver = true;
      clearTimeout(first);
      clearInterval(timer);
    };
  }, [robot, from, to, rounds]);
  useEffect(() => {
    let isOver = false;
    const load = () => !document.hidden && read('requests', { robot }).then((content) => !isOver && setAsked(content), () => {});
    load();
    const timer = setInterval(load, EVERY_MS);
    return () => {
      isOver = true;
      clearInterval(timer);
    };
  }, [robot, rounds]);

  const post = async (what, done) => {
    try {
      const answer = await fetch('/api/pull', { method: 'POST', headers: { 'Content-Type': 'application/json', 'X-CSRF-Token': session.csrf }, body: JSON.stringify({ robot, ...what }) });
      const content = await answer.json();
      setSaid(answer.ok ? ['good', done] : ['bad', `not ${done.split(' ')[0]}: ${content.error}`]);
      if (answer.ok && what.sensor) setMine({ ...what, id: content.id });
    } catch {
      setSaid(['bad', 'the page cannot be reached']);
    }
    again(rounds + 1);
  };
  const sensors = Object.keys(kept);
  if (!sensors.length && !asked.requests.length && !mine) return null;
  const chosen = sensors.includes(sensor) ? sensor : sensors[0];
  const found = kept[chosen];
  // The node numbers its answers after those in the store: it accepts no request while that is unreachable.
  const waits = session.has_live && mine && asked.requests.every((each) => each.id !== mine.id);
  const lost = Object.entries(found?.lost ?? {});
  return html`<div class="pull"><div class="panel-head"><h3 title="Data of the selected time that the robot does not send unless it is requested">Kept on the robot</h3><span class="unit">${clock(from)} for ${span((to - from) / 1000)}</span></div>
    ${found && html`<div class="row"><select aria-label="Sensor" value=${chosen} onChange=${(event) => setSensor(event.target.value)}>${sensors.map((name) => html`<option>${name}</option>`)}</select>
      <span data-offer=${found.objects} title="What the robot keeps of this sensor in this time, and how long sending it takes">${digits(found.objects)} objects, ${volume(found.bytes)}${found.seconds === null ? '' : `, ${span(found.seconds)} at ${found.mbps.toFixed(1)} Mbit/s`}</span>
      ${lost.length > 0 && html`<span class="note bad">${lost.map(([reason, count]) => `${count} lost (${reason})`).join(', ')}</span>`}
      ${mayAct ? html`<button type="button" class="primary" data-act="pull" title="They are sent to the store" disabled=${!found.objects} onClick=${() => post({ sensor: chosen, from, to }, `requested from ${robot}`)}>Request them</button>`
        : html`<span class="unit">an operator can request them</span>`}</div>`}
    ${said[1] && html`<p class=${`note ${said[0]}`} role="status">${said[1]}</p>`}
    <ol class="answers requests" aria-live="polite">${waits && html`<li data-waits-for-node><b>waits</b> ${mine.sensor} ${moment(mine.from)} for ${span((mine.to - mine.from) / 1000)}: the node has the request, and accepts it once the store can be reached. If the node is restarted before, request it again.</li>`}${asked.requests.map((each) => html`<${Request} key=${each.id} each=${each} mbps=${asked.mbps} mayCancel=${mayAct} cancel=${(id) => post({ cancel: id }, 'canceled')} />`)}</ol></div>`;
}
