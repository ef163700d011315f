// What was recorded and what is missing, by topic and time: of today beside the live view, of any day when looking back.
import { html, useEffect, useRef, useState } from './vendor/preact.js';
import {
  busy, clock as shownBy, days, go, leave, list, look, openDay, openRobot, past, playing, problem as pastProblem, range, robots, showBy, speed, told,
} from './past.js';
import { Pull } from './pull.js';
import { clock, digits, meaning, moment, shade, span } from './words.js';

const SPANS = [[15, '15 min'], [60, '1 h'], [360, '6 h'], [0, 'Today']];
const ZOOMS = [[1, '1 min'], [15, '15 min'], [60, '1 h'], [360, '6 h'], [1440, '24 h']];
const SPEEDS = [0.5, 1, 4, 16, 60];
const EVERY_MS = 5000;
const ROW = 26;
const LANE = 17;
const MINUTE = 60000;
const STEPS = [1, 5, 10, 30, 60, 120, 300, 600, 1800, 3600, 7200, 10800].map((seconds) => seconds * 1000);

function ticks(from, to) {
  const step = STEPS.find((each) => (to - from) / each <= 8) ?? 14400000;
  const found = [];
  for (let at = Math.ceil(from / step) * step; at < to; at += step) found.push(at);
  return found;
}

// Marks in lanes, so that none covers another; what does not fit any more goes into the last one.
function lanes(marks, x) {
  const ends = [];
  return marks.map((mark) => {
    const [left, right] = [x(mark.from), Math.max(x(mark.to), x(mark.from) + 8 + (mark.kind === 'event' ? 0 : Math.min(mark.name.length, 22) * 6.2))];
    let lane = ends.findIndex((end) => end <= left);
    if (lane < 0) lane = Math.min(ends.length, 5);
    ends[lane] = Math.max(ends[lane] ?? 0, right + 4);
    return { ...mark, lane };
  });
}

// What is drawn in the hue of a cause, on a tile of 6 by 6.
const MARKS = { bands: 'M0 3h6v2.4h-6z', stripes: 'M0 6L6 0H3L0 3zM6 6V3L3 6z', dots: 'M1.3 3a1.7 1.7 0 1 0 3.4 0a1.7 1.7 0 1 0-3.4 0z', checks: 'M0 0h3v3h-3zM3 3h3v3h-3z' };

function Patterns({ shades }) {
  return shades.filter(([, pattern]) => MARKS[pattern]).map(([hue, pattern]) => html`<pattern id=${`${hue}-${pattern}`} class=${`hue-${hue}`} width="6" height="6" patternUnits="userSpaceOnUse">
    <rect class="solid" width="6" height="6" /><path class="pattern-mark" d=${MARKS[pattern]} /></pattern>`);
}

function paint(cause, also = '') {
  const [hue, pattern] = shade(cause);
  return MARKS[pattern] ? { class: also, fill: `url(#${hue}-${pattern})` } : { class: `${also} hue-${hue} solid` };
}

function Swatch({ cause }) {
  return html`<svg class="swatch" width="12" height="12" data-swatch=${cause} aria-hidden="true"><rect ...${paint(cause)} width="12" height="12" /></svg>`;
}

export function Copy({ text }) {
  const [said, setSaid] = useState('Copy');
  const copy = async () => {
    try {
      if (navigator.clipboard) await navigator.clipboard.writeText(text);
      else { // http is no secure context
        const box = document.createElement('textarea');
        box.value = text;
        document.body.append(box);
        box.select();
        document.execCommand('copy');
        box.remove();
      }
      setSaid('Copied');
    } catch {
      setSaid('Mark it and copy');
    }
    setTimeout(() => setSaid('Copy'), 1500);
  };
  return html`<button type="button" onClick=${copy}>${said}</button>`;
}

function Commands() {
  const [what, setWhat] = useState('moment');
  const commands = (what === 'moment' ? past.value?.commands : told.value?.commands) ?? [];
  return html`<div class="commands"><div class="panel-head"><h3>On a command line</h3><select aria-label="Of which time" value=${what} onChange=${(event) => setWhat(event.target.value)}>
      <option value="moment">5 s around this moment</option><option value="range">all that the timeline shows</option></select></div>
    ${commands.map(([name, line]) => html`<p key=${line}><span class="row-name">${name}</span><code data-command=${name}>${line}</code><${Copy} text=${line} /></p>`)}</div>`;
}

function Transport({ robot }) {
  const { at } = past.value;
  const step = (ms) => go(robot, at + ms);
  return html`<div class="row transport"><button type="button" onClick=${() => step(-10000)} aria-label="10 seconds back">−10 s</button>
    <button type="button" onClick=${() => step(-1000)} aria-label="1 second back">−1 s</button>
    <button type="button" class="primary" onClick=${() => { playing.value = !playing.value; }} aria-pressed=${playing.value} data-play>${playing.value ? 'Pause' : 'Play'}</button>
    <button type="button" onClick=${() => step(1000)} aria-label="1 second on">+1 s</button>
    <button type="button" onClick=${() => step(10000)} aria-label="10 seconds on">+10 s</button>
    <select aria-label="How fast" value=${speed.value} onChange=${(event) => { speed.value = Number(event.target.value); }}>${SPEEDS.map((each) => html`<option value=${each}>${each}×</option>`)}</select>
    <select aria-label="By which time of the messages" value=${shownBy.value} onChange=${(event) => showBy(event.target.value)}>
      <option value="stamp">by stamp</option><option value="received">by arrival</option></select>
    <time class="moment" data-moment=${Math.round(at)}>${moment(at)}</time><span class="unit">UTC${past.value.mission ? ` · ${past.value.mission}` : ''}${busy.value ? ' · reading…' : ''}</span></div>`;
}

// An operator says what there is to see: of this moment, or of the time since "From here".
function LabelForm({ session, robot, begin, setBegin }) {
  const [label, setLabel] = useState('');
  const [note, setNote] = useState('');
  const [said, setSaid] = useState(['', '']);
  const at = Math.round(past.value.at);
  const [from, to] = begin === null ? [at, at] : [Math.min(begin, at), Math.max(begin, at)];
  const submit = async (event) => {
    event.preventDefault();
    try {
      const answer = await fetch('/api/label', { method: 'POST', headers: { 'Content-Type': 'application/json', 'X-CSRF-Token': session.csrf }, body: JSON.stringify({ robot, label, note, from, to }) });
      const content = await answer.json();
      setSaid(answer.ok ? ['good', `labelled ${label}`] : ['bad', content.error]);
      if (!answer.ok) return;
      setLabel('');
      setNote('');
      setBegin(null);
      look(robot, range.value.from, range.value.to);
    } catch {
      setSaid(['bad', 'it cannot be reached']);
    }
  };
  return html`<form class="row label-form" onSubmit=${submit}><input aria-label="Label" name="label" placeholder="label, such as stairs" required maxlength="200" value=${label} onInput=${(event) => setLabel(event.target.value)} />
    <input aria-label="Note on the label" placeholder="a note" maxlength="500" value=${note} onInput=${(event) => setNote(event.target.value)} />
    <button type="button" aria-pressed=${begin !== null} onClick=${() => setBegin(begin === null ? at : null)}>From here</button>
    <button class="primary" data-act="label">${begin === null ? 'Label this moment' : `Label ${span((to - from) / 1000)}`}</button>
    ${said[1] && html`<span class=${`note ${said[0]}`} role="status">${said[1]}</span>`}</form>`;
}

export function Timeline({ session }) {
  const [minutes, setMinutes] = useState(60);
  const [today, setToday] = useState(null);
  const [failed, setFailed] = useState('');
  const [chosen, setChosen] = useState(null);
  const [width, setWidth] = useState(800);
  const [begin, setBegin] = useState(null); // of the time that a label or a request is for, which ends at the moment
  const box = useRef(null);
  const drags = useRef(false);
  const lately = useRef(null); // what the robot's clock was, and when: { now, at }
  const isPast = past.value !== null;
  const isByArrival = shownBy.value === 'received';

  useEffect(() => {
    if (!isPast) return undefined;
    if (!days.value.length) list(past.value.robot);
    const timer = setInterval(() => { // what goes on, or arrives later
      const { robot, from, to } = range.value ?? {};
      if (robot && !document.hidden && to > Date.now() - 600000) look(robot, from, to);
    }, 3 * EVERY_MS);
    return () => clearInterval(timer);
  }, [isPast]);

  useEffect(() => {
    if (isPast) return undefined;
    let isOver = false;
    const load = async () => {
      if (document.hidden) return;
      const now = lately.current ? lately.current.now + performance.now() - lately.current.at : Date.now();
      const asked = minutes ? `?from=${Math.round(now + EVERY_MS - minutes * MINUTE)}&to=${Math.round(now + EVERY_MS)}` : '';
      try {
        const answer = await fetch(`/api/gaps${asked}`);
        const content = await answer.json();
        if (isOver) return;
        if (answer.ok) {
          setToday(content);
          lately.current = { now: content.now, at: performance.now() };
        }
        setFailed(answer.ok ? '' : content.error);
      } catch {
        if (!isOver) setFailed('the robot cannot be reached');
      }
    };
    load();
    const timer = setInterval(load, minutes ? EVERY_MS : 3 * EVERY_MS);
    return () => {
      isOver = true;
      clearInterval(timer);
    };
  }, [minutes, isPast]);

  useEffect(() => {
    const seen = new ResizeObserver(([entry]) => setWidth(entry.contentRect.width));
    seen.observe(box.current);
    return () => seen.disconnect();
  }, []);

  const found = isPast ? told.value ?? today : today;
  const problem = isPast ? pastProblem.value : failed;
  const robot = range.value?.robot ?? past.value?.robot ?? session.robot;
  const gaps = (found?.gaps ?? []).map((row) => Object.fromEntries(found.columns.map((name, place) => [name, row[place]])));
  const recorded = found?.recorded ?? [];
  const kept = found?.kept ?? [];
  const topics = [...new Set([...(found?.known ?? []), ...recorded, ...kept].map(([topic]) => topic).concat(gaps.map((gap) => gap.topic)))].sort().slice(0, 60);
  const left = width < 520 ? 92 : 150;
  const { from = 0, to = 1, now = 0 } = found ?? {};
  const x = (ms) => left + ((Math.min(Math.max(ms, from), to) - from) / (to - from)) * (width - left - 8);
  const timeAt = (event) => from + Math.min(1, Math.max(0, (event.clientX - box.current.getBoundingClientRect().left - left) / (width - left - 8))) * (to - from);
  const marks = lanes((found?.marks ?? []).map(([kind, name, begin, end, text]) => ({ kind, name, from: begin, to: end, text })), x);
  const top = marks.length ? (Math.max(...marks.map((mark) => mark.lane)) + 1) * LANE + 6 : 0;
  const height = top + topics.length * ROW + 26;
  const seen = new Map();
  const shades = [...new Map([...gaps, ...(chosen ? [chosen] : [])].map(({ cause }) => [shade(cause).join(), shade(cause)])).values()];
  for (const gap of gaps) {
    const name = `${gap.kind} ${gap.cause}`;
    const known = seen.get(name) ?? { ...gap, messages: 0, rows: 0 };
    known.messages += gap.count;
    known.rows += 1;
    seen.set(name, known);
  }

  const pick = (at) => {
    if (!isPast) look(robot, from, Math.max(to, at));
    go(robot, Math.min(at, now || at));
  };
  const down = (event) => {
    if (event.button || event.clientX - box.current.getBoundingClientRect().left < left) return;
    drags.current = true;
    playing.value = false;
    event.currentTarget.setPointerCapture(event.pointerId);
    pick(timeAt(event));
  };
  const drag = (event) => drags.current && pick(timeAt(event));
  const key = (event) => {
    const step = { ArrowLeft: -1000, ArrowRight: 1000, PageUp: -60000, PageDown: 60000 }[event.key];
    if (!step || !found) return;
    event.preventDefault();
    pick((past.value?.at ?? now) + step * (event.shiftKey ? 10 : 1));
  };
  const zoom = (each) => {
    const middle = past.value.at;
    look(robot, middle - (each * MINUTE) / 2, middle + (each * MINUTE) / 2);
  };
  const zoomed = range.value ? Math.round((range.value.to - range.value.from) / MINUTE) : 0;
  const missions = marks.filter((mark) => mark.kind === 'mission');
  const label = (topic) => (topic.length > (left - 12) / 6.6 ? `…${topic.slice(-Math.floor((left - 18) / 6.6))}` : topic);

  return html`<div class="panel timeline">
    <div class="panel-head">
      <h3>${isPast ? 'Back in time' : minutes ? `The last ${SPANS.find(([each]) => each === minutes)[1]}` : 'Today'} <span class="unit">UTC</span></h3>
      ${isPast && html`${robots.value.length > 1 && html`<select aria-label="Robot" value=${robot} onChange=${(event) => openRobot(event.target.value)}>${robots.value.map((each) => html`<option>${each}</option>`)}</select>`}
        <select aria-label="Day" value=${range.value ? new Date(range.value.from).toISOString().slice(0, 10) : ''} onChange=${(event) => openDay(robot, event.target.value)}>
          ${days.value.map((each) => html`<option>${each}</option>`)}</select>
        ${missions.length > 0 && html`<select aria-label="Mission" onChange=${(event) => {
          const mission = missions[event.target.value];
          if (!mission) return;
          const edge = Math.max(2000, (mission.to - mission.from) * 0.03);
          look(robot, mission.from - edge, mission.to + edge);
          go(robot, mission.from);
        }}><option value="">Missions</option>${missions.map((mission, place) => html`<option value=${place}>${mission.name}</option>`)}</select>`}`}
      <div class="tabs" role="group" aria-label="How long">
        ${isPast ? ZOOMS.map(([each, name]) => html`<button type="button" aria-pressed=${each === zoomed} onClick=${() => zoom(each)}>${name}</button>`)
          : SPANS.map(([each, name]) => html`<button type="button" aria-pressed=${each === minutes} onClick=${() => setMinutes(each)}>${name}</button>`)}
      </div>
      ${isPast ? session.has_live && html`<button type="button" class="primary" onClick=${leave}>Back to now</button>` : html`<button type="button" class="primary" onClick=${() => openRobot(session.robot)}>Back in time</button>`}
    </div>
    ${isPast && html`<${Transport} robot=${robot} />`}
    ${isPast && isByArrival && session.role === 'operator' && html`<p class="note">Labels and requests are by stamp.</p>`}
    ${isPast && !isByArrival && session.role === 'operator' && html`<${LabelForm} session=${session} robot=${robot} begin=${begin} setBegin=${setBegin} />`}
    ${isPast && !isByArrival && html`<${Pull} session=${session} robot=${robot} begin=${begin} />`}
    <div ref=${box} class="timeline-box">
      ${problem && html`<p class="note bad" role="alert">${problem}</p>`}
      ${isPast && found?.problem && html`<p class="note watch">${found.problem}</p>`}
      ${!problem && found && !topics.length && html`<p class="empty">Nothing was recorded in this time.</p>`}
      ${topics.length > 0 && html`<svg width=${width} height=${height} tabindex="0" role="slider" aria-label="Time: click, drag or arrow keys show a moment; the table below has all gaps"
          aria-valuemin=${Math.round(from)} aria-valuemax=${Math.round(to)} aria-valuenow=${Math.round(past.value?.at ?? now)} aria-valuetext=${moment(past.value?.at ?? now)}
          onPointerDown=${down} onPointerMove=${drag} onPointerUp=${() => { drags.current = false; }} onPointerCancel=${() => { drags.current = false; }} onKeyDown=${key}>
        <defs><pattern id="unknown" width="6" height="6" patternUnits="userSpaceOnUse" patternTransform="rotate(45)">
          <rect class="unknown-back" width="6" height="6" /><rect class="unknown-line" width="2" height="6" /></pattern><${Patterns} shades=${shades} /></defs>
        ${ticks(from, to).map((at) => html`<g><line class="tick" x1=${x(at)} x2=${x(at)} y1="0" y2=${height - 22} />
          <text class="tick-label" x=${x(at)} y=${height - 6}>${clock(at, to - from < 600000)}</text></g>`)}
        ${marks.map((mark) => html`<g class=${`mark-of-${mark.kind}`} data-mark=${mark.kind} data-from=${mark.from} data-to=${mark.to} data-name=${mark.name} transform=${`translate(0 ${mark.lane * LANE})`}>
          <title>${`${mark.kind} ${mark.name}${mark.text ? ` (${mark.text})` : ''}, ${clock(mark.from)}`}</title>
          ${mark.kind === 'event' ? html`<path d=${`M${x(mark.from)} 2l6 6l-6 6l-6-6z`} />`
            : html`<rect x=${x(mark.from)} y="1" width=${Math.max(3, x(mark.to) - x(mark.from))} height=${LANE - 3} rx="3" />
              <text x=${x(mark.from) + 4} y="12">${mark.name.length > 22 ? `${mark.name.slice(0, 21)}…` : mark.name}</text>`}</g>`)}
        ${topics.map((topic, place) => html`<g transform=${`translate(0 ${top + place * ROW})`}>
          <text class="row-label" x="0" y=${ROW / 2 + 4}><title>${topic}</title>${label(topic)}</text>
          <rect class="unknown" x=${left} y="5" width=${Math.max(0, x(now) - left)} height=${ROW - 10} rx="3" fill="url(#unknown)"><title>not known (yet)</title></rect>
          ${found.known.filter(([name]) => name === topic).map(([, since, until]) => html`<rect class="known" data-topic=${topic} data-from=${since} data-to=${until}
            x=${x(since)} y="5" width=${Math.max(1, x(until) - x(since))} height=${ROW - 10} rx="3" />`)}
          ${recorded.filter(([name]) => name === topic).map(([, since, until]) => html`<rect class="recorded" data-topic=${topic} data-from=${since} data-to=${until}
            x=${x(since)} y=${ROW - 9} width=${Math.max(1.5, x(until) - x(since))} height="4" rx="1" />`)}
          ${kept.filter(([name]) => name === topic).map(([, since, until]) => html`<rect class="kept" data-topic=${topic} data-from=${since} data-to=${until}
            x=${x(since)} y=${ROW - 9} width=${Math.max(1.5, x(until) - x(since))} height="4" rx="1"><title>kept on the robot</title></rect>`)}
          ${gaps.filter((gap) => gap.topic === topic).map((gap) => html`<rect ...${paint(gap.cause, 'gap')} data-topic=${topic} data-kind=${gap.kind}
            data-cause=${gap.cause} data-from=${gap.from} data-to=${gap.to} data-count=${gap.count} x=${x(gap.from)} y="3"
            width=${Math.max(2.5, x(gap.to) - x(gap.from))} height=${ROW - 6} rx="1.5" onPointerEnter=${() => setChosen(gap)}>
            <title>${`${topic}: ${gap.count} ${gap.kind} (${gap.cause}), ${clock(gap.from)} for ${span((gap.to - gap.from) / 1000)}`}</title></rect>`)}
        </g>`)}
        ${now < to && now > from && html`<line class="now" x1=${x(now)} x2=${x(now)} y1="0" y2=${height - 22} />`}
        ${isPast && begin !== null && html`<rect class="span" x=${x(Math.min(begin, past.value.at))} y="0" width=${Math.abs(x(past.value.at) - x(begin))} height=${height - 22} />`}
        ${isPast && past.value.at >= from && past.value.at <= to && html`<g class="cursor"><line x1=${x(past.value.at)} x2=${x(past.value.at)} y1="0" y2=${height - 22} /><circle cx=${x(past.value.at)} cy=${height - 22} r="5" /></g>`}
      </svg>`}
    </div>
    <div class="legend">
      ${isPast && html`<span><i class="swatch recorded"></i>recorded</span>`}
      ${kept.length > 0 && html`<span><i class="swatch kept"></i>kept on the robot</span>`}
      <span><i class="swatch known"></i>nothing else is missing</span><span><i class="swatch unknown"></i>not known yet</span>
      ${[...seen.values()].map((each) => html`<span title=${meaning(each.cause)}><${Swatch} cause=${each.cause} />${each.kind}: ${each.cause.replaceAll('_', ' ')} <b>${digits(each.messages)}</b></span>`)}
      ${['mission', 'bag', 'event', 'label'].filter((kind) => marks.some((mark) => mark.kind === kind)).map((kind) => html`<span><i class=${`swatch of-${kind}`}></i>${kind}</span>`)}
      ${found && !gaps.length && topics.length > 0 && html`<span class="good">no gap is known in this time</span>`}
      ${!isPast && topics.length > 0 && html`<span class="unit">click on a time to see it again</span>`}
    </div>
    ${chosen && html`<p class="chosen" aria-live="polite"><${Swatch} cause=${chosen.cause} /><b>${chosen.topic}</b> ${digits(chosen.count)} messages
      ${chosen.kind}, ${meaning(chosen.cause)}: from ${clock(chosen.from)} for ${span((chosen.to - chosen.from) / 1000)}${chosen.grade === 'exact' ? '' : ' (estimated)'}</p>`}
    ${isPast && html`<${Commands} />`}
    ${gaps.length > 0 && html`<details><summary>All ${gaps.length} gaps as a table</summary><div class="scroll"><table class="gaps-table"><thead><tr><th>Topic</th><th>From</th><th class="n">For</th>
      <th class="n">Messages</th><th>What</th><th>Cause</th></tr></thead><tbody>${gaps.slice(-500).map((gap) => html`<tr><td>${gap.topic}</td><td>${clock(gap.from)}</td>
      <td class="n">${span((gap.to - gap.from) / 1000)}</td><td class="n">${digits(gap.count)}</td><td>${gap.kind}</td><td>${gap.cause.replaceAll('_', ' ')}</td></tr>`)}</tbody></table></div></details>`}
  </div>`;
}
