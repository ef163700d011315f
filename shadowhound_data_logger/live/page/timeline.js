// What was recorded and what is missing, by topic and time: of today beside the live view, of any day when looking back.
import { html, useEffect, useMemo, useRef, useState } from './vendor/preact.js';
import { Fleet } from './fleet.js';
import { GapWords } from './gaps.js';
import { Losses } from './losses.js';
import {
  busy, clock as shownBy, days, go, leave, list, look, openDay, openRobot, pan, past, playing, problem as pastProblem, range, robots, selection, showBy, spanOf, speed,
  timeline, timelineProblem, told, zoom,
} from './past.js';
import { Pull } from './pull.js';
import { clock, digits, meaning, moment, shade, span, volume } from './words.js';

const SPANS = [[15, '15 min'], [60, '1 h'], [360, '6 h'], [0, 'Today']];
const ZOOMS = [[1, '1 min'], [15, '15 min'], [60, '1 h'], [360, '6 h'], [1440, '24 h']];
const SPEEDS = [0.5, 1, 4, 16, 60];
const EVERY_MS = 5000;
const ROW = 26;
const LANE = 17;
const AXIS = 26;
const TICK = 62; // px between two times, at least
const MINUTE = 60000;
const DAY = 1440 * MINUTE;
const AROUND_MS = 5000; // of a moment, on either side
const CLICK_PX = 4; // what moves less is no drag
const STEPS = [1, 5, 10, 30, 60, 120, 300, 600, 1800, 3600, 7200, 10800, 14400, 21600, 43200].map((seconds) => seconds * 1000);
const MARKED = { mission: 'A mission, from its start to its end', bag: 'A bag that was recorded', event: 'An event, at the time of its trigger', label: 'A label that an operator added' };
const exact = (ms) => new Date(ms).toISOString().slice(11, 21);
const named = (found) => (found?.gaps ?? []).map((row) => Object.fromEntries(found.columns.map((name, place) => [name, row[place]])));

function ticks(from, to, most) {
  const step = STEPS.find((each) => (to - from) / each <= most) ?? DAY;
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

// A piece of a bag: made when somebody asks for it, then a link that other viewers can open too.
const VIEWERS = [['Foxglove', 'https://app.foxglove.dev/~/view?ds=remote-file&ds.url='], ['Foxglove on this computer', 'foxglove://open?ds=remote-file&ds.url='], ['Lichtblick', 'lichtblick://open?ds=remote-file&ds.url=']];
function Piece({ session, robot, bag, size, from, to }) {
  const [state, setState] = useState('');
  const [made, setMade] = useState(null);
  const cut = async () => {
    setState('cutting…');
    try {
      const answer = await fetch('/api/cut', { method: 'POST', headers: { 'Content-Type': 'application/json', 'X-CSRF-Token': session.csrf }, body: JSON.stringify({ robot, bag, from, to }) });
      const content = await answer.json();
      setState(answer.ok ? '' : content.error);
      if (answer.ok) setMade(content);
    } catch {
      setState('it cannot be reached');
    }
  };
  const address = made && new URL(made.path, location.href).href;
  return html`<p class="download" data-bag=${bag}><span class="row-name" title="A bag that was recorded in this time">bag</span><span>${bag} <span class="unit">${made ? html`${digits(made.messages)} messages, ${volume(made.bytes)}, ${span(made.seconds)}${made.seconds < (to - from) / 1000 - 2 ? ` of the ${span((to - from) / 1000)}: the rest is not in the closed files of the bag` : ''}; the links work for 15 minutes` : `the files of this time have ${volume(size)}`}</span>
      ${state && state !== 'cutting…' && html` <span class="note bad" role="alert">${state}</span>`}</span>
    ${made ? html`<span class="links"><a class="button" data-piece href=${made.path} download>Download MCAP</a>${VIEWERS.map(([name, link]) => html`<a class="button" data-viewer=${name} target="_blank" rel="noopener" href=${link + encodeURIComponent(address)}>${name}</a>`)}</span>`
      : html`<button type="button" data-cut=${bag} disabled=${state === 'cutting…'} onClick=${cut}>${state === 'cutting…' ? state : 'Cut as MCAP'}</button>`}</p>`;
}

const COMMANDS = {
  query: 'Lists the objects of this time in the store', fetch: 'Downloads them into the folder data', 'bag cut': 'Makes a bag of this time from the files of a bag in the store, in the folder cut',
  export: 'Makes a LeRobot dataset from the mission', pull: 'Requests what only the robot has of this time',
};

// The commands of a time, as they can be pasted into a shell; the bags that have it can be downloaded here.
function Commands({ session, robot, selected }) {
  const [what, setWhat] = useState('');
  const [found, setFound] = useState(null);
  const [failed, setFailed] = useState('');
  const chosen = what === 'selection' && !selected ? '' : what || (selected ? 'selection' : 'moment');
  const { at } = past.value;
  const [from, to] = chosen === 'selection' ? selected : chosen === 'range' && range.value ? [range.value.from, range.value.to] : chosen === 'minute' ? [at - MINUTE / 2, at + MINUTE / 2] : [at - AROUND_MS, at + AROUND_MS];
  useEffect(() => {
    if (chosen === 'moment') return undefined; // its answer has them
    let isOver = false;
    const timer = setTimeout(() => spanOf(robot, from, to).then((content) => { if (!isOver) { setFound(content); setFailed(''); } }, (error) => !isOver && setFailed(error.message)), 250);
    return () => {
      isOver = true;
      clearTimeout(timer);
    };
  }, [robot, from, to, chosen, shownBy.value]);
  const commands = chosen === 'moment' ? past.value.commands : found?.commands ?? [];
  const bags = chosen === 'moment' ? [] : found?.bags ?? [];
  return html`<div class="commands"><div class="panel-head"><h3 title="Commands for a terminal that get the data of this time from the store, and bags that can be downloaded here">Get this data: commands and bags</h3><select aria-label="Of which time" value=${chosen} onChange=${(event) => setWhat(event.target.value)}>
      ${selected && html`<option value="selection">the selected ${span((to - from) / 1000)}</option>`}
      <option value="moment">5 s around this moment</option><option value="minute">the minute around this moment</option><option value="range">all that the timeline shows</option></select></div>
    ${failed && html`<p class="note bad" role="alert">${failed}</p>`}
    ${bags.map(([bag, size, start, end]) => html`<${Piece} key=${`${bag} ${start} ${end}`} session=${session} robot=${robot} bag=${bag} size=${size} from=${start} to=${end} />`)}
    ${chosen !== 'moment' && found && !bags.length && html`<p class="note">No bag was recorded in this time, so there is none to cut; fetch gets its objects.</p>`}
    ${commands.map(([name, line]) => html`<p key=${line}><span class="row-name" title=${COMMANDS[name]}>${name}</span><code data-command=${name}>${line}</code><${Copy} text=${line} /></p>`)}</div>`;
}

function Transport({ robot, begin, setBegin, jump }) {
  const { at } = past.value;
  const [percent, setPercent] = useState(30);
  const step = (ms) => go(robot, at + ms);
  const jumps = [['gap', -1, '‹ Gap', 'Previous gap'], ['gap', 1, 'Gap ›', 'Next gap'], ['event', -1, '‹ Event', 'Previous event'], ['event', 1, 'Event ›', 'Next event']];
  return html`<div class="row transport"><button type="button" onClick=${() => step(-10000)} aria-label="10 seconds back">−10 s</button>
    <button type="button" onClick=${() => step(-1000)} aria-label="1 second back">−1 s</button>
    <button type="button" class="primary" onClick=${() => { playing.value = !playing.value; }} aria-pressed=${playing.value} data-play>${playing.value ? 'Pause' : 'Play'}</button>
    <button type="button" onClick=${() => step(1000)} aria-label="1 second on">+1 s</button>
    <button type="button" onClick=${() => step(10000)} aria-label="10 seconds on">+10 s</button>
    <select aria-label="How fast" value=${speed.value} onChange=${(event) => { speed.value = Number(event.target.value); }}>${SPEEDS.map((each) => html`<option value=${each}>${each}×</option>`)}</select>
    <select aria-label="By which time of the messages" title="Stamp: when it was measured. Arrival: when the robot's computer got it." value=${shownBy.value} onChange=${(event) => showBy(event.target.value)}>
      <option value="stamp">by stamp</option><option value="received">by arrival</option></select>
    <span class="tabs" role="group" aria-label="Jump to">${jumps.map(([what, direction, name, said]) => html`<button type="button" aria-label=${said} data-jump=${`${what} ${direction}`} onClick=${() => jump(what, direction)}>${name}</button>`)}</span>
    ${told.value?.battery?.length > 0 && html`<span class="below"><button type="button" data-jump="battery" title="Go to the first time in what the timeline shows at which the charge is lower" onClick=${() => jump('battery', percent)}>Battery below</button>
      <input type="number" min="1" max="100" aria-label="Percent of charge" value=${percent} onInput=${(event) => setPercent(Number(event.target.value))} /> %</span>`}
    <button type="button" aria-pressed=${begin !== null} title="Select the time from this moment to where you go next" onClick=${() => { selection.value = null; setBegin(begin === null ? Math.round(at) : null); }}>From here</button>
    <time class="moment" data-moment=${Math.round(at)}>${moment(at)}</time><span class="unit">UTC${past.value.mission ? ` · ${past.value.mission}` : ''}${busy.value ? ' · reading…' : ''}</span></div>`;
}

function Selected({ selected, clear }) {
  const [from, to] = selected;
  return html`<p class="row selected" data-selected=${`${Math.round(from)} ${Math.round(to)}`}><b>Selected</b> ${exact(from)} to ${exact(to)} <span class="unit">UTC, ${span((to - from) / 1000)}</span>
    <button type="button" onClick=${() => look(range.value.robot, from - (to - from) * 0.1, to + (to - from) * 0.1)}>Zoom to it</button>
    <button type="button" onClick=${() => document.querySelector('.commands')?.scrollIntoView({ block: 'nearest' })}>Commands and downloads</button>
    <button type="button" onClick=${clear}>Clear</button></p>`;
}

// An operator says what there is to see: of this moment, or of the time that is selected.
function LabelForm({ session, robot, selected, clear }) {
  const [label, setLabel] = useState('');
  const [note, setNote] = useState('');
  const [said, setSaid] = useState(['', '']);
  const at = Math.round(past.value.at);
  const [from, to] = selected?.map(Math.round) ?? [at, at];
  const submit = async (event) => {
    event.preventDefault();
    try {
      const answer = await fetch('/api/label', { method: 'POST', headers: { 'Content-Type': 'application/json', 'X-CSRF-Token': session.csrf }, body: JSON.stringify({ robot, label, note, from, to }) });
      const content = await answer.json();
      setSaid(answer.ok ? ['good', `labeled ${label}`] : ['bad', `not labeled: ${content.error}`]);
      if (!answer.ok) return;
      setLabel('');
      setNote('');
      clear();
      look(robot, range.value.from, range.value.to);
    } catch {
      setSaid(['bad', 'not labeled: the page cannot be reached']);
    }
  };
  return html`<form class="row label-form" onSubmit=${submit}><input aria-label="Label" name="label" placeholder="label, such as stairs" required maxlength="200" value=${label} onInput=${(event) => setLabel(event.target.value)} />
    <input aria-label="Note on the label" placeholder="a note" maxlength="500" value=${note} onInput=${(event) => setNote(event.target.value)} />
    <button class="primary" data-act="label">${!selected ? 'Label this moment' : `Label ${span((to - from) / 1000)}`}</button>
    ${said[1] && html`<span class=${`note ${said[0]}`} role="status">${said[1]}</span>`}</form>`;
}

// The charge at a time: the newest before it.
function chargeAt(battery, at) {
  const before = battery.filter(([each]) => each <= at);
  return (before.at(-1) ?? battery[0])?.[1];
}

// The part of a time that has anything in it, with some room; all of it where that is most of it.
function fitted(found) {
  const begins = [...found.known.map(([, since]) => since), ...found.gaps.map((row) => row[4])].filter((each) => each > found.from);
  const until = Math.min(found.to, found.now + (found.to - found.from) * 0.01);
  const since = begins.length ? Math.max(found.from, Math.min(...begins)) : found.from;
  return since - found.from < (found.to - found.from) / 2 ? [found.from, found.to] : [since - (until - since) * 0.04, until + (until - since) * 0.02];
}

export function Timeline({ session }) {
  const [minutes, setMinutes] = useState(60);
  const [today, setToday] = useState(null);
  const [failed, setFailed] = useState('');
  const [chosen, setChosen] = useState(null);
  const [late, setLate] = useState(null);
  const [note, setNote] = useState('');
  const [width, setWidth] = useState(800);
  const [begin, setBegin] = useState(null); // of a time that ends at the moment
  const box = useRef(null);
  const drag = useRef(null); // what the pointer does: { what, ... }
  const lately = useRef(null); // what the robot's clock was, and when: { now, at }
  const acts = useRef({});
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
    const wheel = (event) => acts.current.wheel(event);
    box.current.addEventListener('wheel', wheel, { passive: false });
    return () => seen.disconnect();
  }, []);

  const found = isPast ? told.value ?? today : today;
  const problem = isPast ? timelineProblem.value || pastProblem.value : failed;
  const robot = range.value?.robot ?? past.value?.robot ?? session.robot;
  const gaps = useMemo(() => named(found), [found]);
  const { now = 0 } = found ?? {};
  const [from, to] = isPast && range.value ? [range.value.from, range.value.to] : found ? fitted(found) : [0, 1];
  const at = past.value?.at ?? now;
  const marked = isPast ? selection.value ?? (begin !== null ? { from: Math.min(begin, at), to: Math.max(begin, at) } : null) : null;
  const selected = marked && marked.to - marked.from >= 1 ? [marked.from, marked.to] : null;
  const left = width < 520 ? 92 : 150;
  const x = (ms) => left + ((Math.min(Math.max(ms, from), to) - from) / (to - from)) * (width - left - 8);
  const timeAt = (event) => from + Math.min(1, Math.max(0, (event.clientX - box.current.getBoundingClientRect().left - left) / (width - left - 8))) * (to - from);
  const isSeen = (since, until) => until >= from && since <= to;
  const recorded = found?.recorded ?? [];
  const kept = found?.kept ?? [];
  const deliveries = found?.deliveries ?? [];
  const battery = (isPast && found?.battery) || [];
  const topics = useMemo(() => [...new Set([...(found?.known ?? []), ...recorded, ...kept].map(([topic]) => topic).concat(gaps.map((gap) => gap.topic)))].sort().slice(0, 60), [found]);
  const marks = lanes((found?.marks ?? []).filter(([, , since, until]) => isSeen(since, until)).map(([kind, name, since, until, text]) => ({ kind, name, from: since, to: until, text })), x);
  const top = marks.length ? (Math.max(...marks.map((mark) => mark.lane)) + 1) * LANE + 6 : 0;
  const rows = topics.length + (deliveries.length ? 1 : 0) + (battery.length ? 1 : 0);
  const height = top + rows * ROW + AXIS;
  const seen = new Map();
  const shades = [...new Map([...gaps, ...(chosen ? [chosen] : [])].map(({ cause }) => [shade(cause).join(), shade(cause)])).values()];
  for (const gap of gaps) {
    const known = seen.get(gap.cause) ?? { cause: gap.cause, messages: 0, kinds: new Set() };
    known.messages += gap.count;
    known.kinds.add(gap.kind);
    seen.set(gap.cause, known);
  }

  const clear = () => {
    selection.value = null;
    setBegin(null);
  };
  const pick = (ms) => {
    setChosen(null);
    setLate(null);
    if (!isPast && ms < from) look(robot, ms - (to - from) / 2, ms + (to - from) / 2);
    else if (!isPast) look(robot, from, Math.max(to, ms));
    go(robot, Math.min(ms, now || ms));
  };
  const show = (gap) => {
    pick(gap.from);
    setChosen(gap);
  };
  const down = (event) => {
    const place = event.clientX - box.current.getBoundingClientRect().left;
    if (event.button || place < left) return;
    playing.value = false;
    event.currentTarget.setPointerCapture(event.pointerId);
    const ms = timeAt(event);
    const edge = event.target.closest?.('[data-edge]')?.dataset.edge;
    const isAxis = event.clientY - event.currentTarget.getBoundingClientRect().top > height - AXIS || event.target.closest?.('.cursor');
    const gap = gaps[event.target.dataset?.gap];
    drag.current = { what: edge ? 'edge' : event.shiftKey ? 'brush' : isAxis ? 'scrub' : 'pan', x: event.clientX, ms, from, to, gap, late: deliveries[event.target.dataset?.late], fixed: edge === 'from' ? marked?.to : edge ? marked?.from : ms, moved: false };
    if (event.shiftKey && !isPast) pick(ms);
    if (drag.current.what === 'scrub') pick(ms);
  };
  const move = (event) => {
    const doing = drag.current;
    if (!doing || (!doing.moved && Math.abs(event.clientX - doing.x) < CLICK_PX)) return;
    doing.moved = true;
    const ms = timeAt(event);
    if (doing.what === 'scrub') pick(ms);
    else if (doing.what === 'pan') {
      const by = ((doing.x - event.clientX) / (width - left - 8)) * (doing.to - doing.from);
      if (!isPast) go(robot, Math.min(doing.ms, now));
      look(robot, doing.from + by, doing.to + by);
    } else {
      setBegin(null);
      selection.value = { from: Math.min(doing.fixed, ms), to: Math.max(doing.fixed, ms) };
    }
  };
  const up = () => {
    const doing = drag.current;
    drag.current = null;
    if (!doing || doing.moved || doing.what !== 'pan') return;
    if (doing.gap) show(doing.gap);
    else {
      pick(doing.ms);
      setLate(doing.late ?? null);
    }
  };
  const jump = async (what, direction) => {
    setNote('');
    if (what === 'battery') {
      const low = battery.find(([, percent]) => percent < direction);
      return low ? pick(low[0]) : setNote(`The battery is not below ${direction} % in the time that is shown.`);
    }
    const edge = 1;
    const list_ = (of) => (what === 'gap' ? named(of).map((gap) => ({ at: gap.from, gap })) : (of.marks ?? []).filter(([kind]) => kind === 'event' || kind === 'label').map(([, , since]) => ({ at: since })))
      .filter((each) => (direction > 0 ? each.at > at + edge : each.at < at - edge)).sort((a, b) => direction * (a.at - b.at) || (b.gap?.count ?? 0) - (a.gap?.count ?? 0));
    let [next] = list_(found ?? {});
    try {
      if (!next) [next] = list_(direction > 0 ? await timeline(robot, at, at + DAY) : await timeline(robot, at - DAY, at));
    } catch (error) {
      return setNote(error.message);
    }
    if (!next) return setNote(`There is no ${direction > 0 ? 'later' : 'earlier'} ${what} within 24 hours.`);
    if (next.at < from || next.at > to) look(robot, next.at - (to - from) / 2, next.at + (to - from) / 2);
    if (next.gap) show(next.gap);
    else pick(next.at);
    return undefined;
  };
  const scale = (factor, middle) => {
    if (isPast) zoom(middle, factor);
    else setMinutes(Math.min(1440, Math.max(1, ((to - from) / MINUTE) * factor)));
  };
  acts.current.wheel = (event) => {
    if (!found || !event.target.closest?.('svg[role=slider]') || (!isPast && !event.ctrlKey && document.activeElement !== event.target.closest('svg'))) return; // the page scrolls
    event.preventDefault();
    const step = Math.max(-240, Math.min(240, event.deltaMode ? event.deltaY * 30 : event.deltaY));
    if (isPast && (event.shiftKey || Math.abs(event.deltaX) > Math.abs(event.deltaY))) pan(((event.deltaX || step) / width) * (to - from));
    else scale(1.0025 ** step, timeAt(event));
  };
  const key = (event) => {
    const step = { ArrowLeft: -1000, ArrowRight: 1000, PageUp: -60000, PageDown: 60000 }[event.key];
    const mark = (side) => {
      const other = side === 'from' ? selection.value?.to ?? at + 1000 : selection.value?.from ?? at - 1000;
      setBegin(null);
      selection.value = { from: Math.min(at, other), to: Math.max(at, other) };
    };
    const others = {
      '+': () => scale(0.5, at), '=': () => scale(0.5, at), '-': () => scale(2, at), 0: () => isPast && look(robot, from, to, { fit: 1 }), '[': () => isPast && mark('from'), ']': () => isPast && mark('to'),
      Escape: clear, n: () => jump('gap', 1), p: () => jump('gap', -1), e: () => jump('event', 1), E: () => jump('event', -1), ' ': () => isPast && (playing.value = !playing.value),
    };
    if (!found || event.ctrlKey || event.metaKey || (!step && !others[event.key])) return;
    event.preventDefault();
    if (step) pick(at + step * (event.shiftKey ? 10 : 1));
    else others[event.key]();
  };
  const around = (each) => look(robot, at - (each * MINUTE) / 2, at + (each * MINUTE) / 2);
  const zoomed = range.value ? Math.round((range.value.to - range.value.from) / MINUTE) : 0;
  const missions = marks.filter((mark) => mark.kind === 'mission');
  const label = (topic) => (topic.length > (left - 12) / 6.6 ? `…${topic.slice(-Math.floor((left - 18) / 6.6))}` : topic);
  const bar = (kind, topic, title) => ([, since, until]) => html`<rect class=${kind} data-topic=${topic} data-from=${since} data-to=${until} x=${x(since)} width=${Math.max(kind === 'known' ? 1 : 1.5, x(until) - x(since))}
    y=${kind === 'known' ? 5 : ROW - 9} height=${kind === 'known' ? ROW - 10 : 4} rx=${kind === 'known' ? 3 : 1}>${title && html`<title>${title}</title>`}</rect>`;
  const body = useMemo(() => topics.map((topic, place) => {
    const of = (each) => each[0] === topic && isSeen(each[1], each[2]);
    return html`<g transform=${`translate(0 ${top + place * ROW})`}>
      <text class="row-label" x="0" y=${ROW / 2 + 4}><title>${topic}</title>${label(topic)}</text>
      <rect class="unknown" x=${left} y="5" width=${Math.max(0, x(now) - left)} height=${ROW - 10} rx="3" fill="url(#unknown)"><title>not known (yet)</title></rect>
      ${found.known.filter(of).map(bar('known', topic))}${recorded.filter(of).map(bar('recorded', topic))}${kept.filter(of).map(bar('kept', topic, 'kept on the robot'))}
      ${gaps.map((gap, number) => gap.topic === topic && isSeen(gap.from, gap.to) && html`<rect ...${paint(gap.cause, 'gap')} data-gap=${number} data-topic=${topic} data-kind=${gap.kind}
        data-cause=${gap.cause} data-from=${gap.from} data-to=${gap.to} data-count=${gap.count} x=${x(gap.from)} y="3"
        width=${Math.max(2.5, x(gap.to) - x(gap.from))} height=${ROW - 6} rx="1.5" onPointerEnter=${() => { if (!drag.current) setChosen(gap); }}>
        <title>${`${topic}: ${gap.count} ${gap.kind} (${gap.cause}), ${clock(gap.from)} for ${span((gap.to - gap.from) / 1000)}`}</title></rect>`)}
    </g>`;
  }), [found, from, to, width, top, now]);
  const wait = (each) => `recorded ${clock(each[0])} to ${clock(each[1])}, ${each[2] === null ? 'not all of it is delivered yet' : `delivered until ${clock(each[2])}`}`;

  return html`${isPast && robots.value.length > 1 && html`<${Fleet} chosen=${robot} names=${robots.value} />`}<div class="panel timeline">
    <div class="panel-head">
      <h3 title=${isPast ? 'What was recorded and what is missing, by topic and time' : 'What is missing, by topic and time'}>${isPast ? 'Back in time' : minutes ? `The last ${span((to - from) / 1000)}` : 'Today'} <span class="unit">UTC</span></h3>
      ${isPast && html`${robots.value.length > 1 && html`<select aria-label="Robot" value=${robot} onChange=${(event) => openRobot(event.target.value)}>${robots.value.map((each) => html`<option>${each}</option>`)}</select>`}
        <select aria-label="Day" value=${range.value ? new Date(Math.max(0, range.value.from)).toISOString().slice(0, 10) : ''} onChange=${(event) => openDay(robot, event.target.value)}>
          ${days.value.map((each) => html`<option>${each}</option>`)}</select>
        ${missions.length > 0 && html`<select aria-label="Mission" onChange=${(event) => {
          const mission = missions[event.target.value];
          if (!mission) return;
          const edge = Math.max(2000, (mission.to - mission.from) * 0.03);
          look(robot, mission.from - edge, mission.to + edge);
          go(robot, mission.from);
        }}><option value="">Missions</option>${missions.map((mission, place) => html`<option value=${place}>${mission.name}</option>`)}</select>`}`}
      <div class="tabs" role="group" aria-label="How long">
        ${isPast ? [...ZOOMS.map(([each, name]) => html`<button type="button" aria-pressed=${each === zoomed} onClick=${() => around(each)}>${name}</button>`),
          html`<button type="button" title="All that was recorded in these 24 hours" onClick=${() => look(robot, Math.min(from, at - DAY / 2), Math.max(to, at + DAY / 2), { fit: 1 })}>Fit</button>`]
          : SPANS.map(([each, name]) => html`<button type="button" aria-pressed=${each === minutes} onClick=${() => setMinutes(each)}>${name}</button>`)}
      </div>
      ${isPast ? session.has_live && html`<button type="button" class="primary" onClick=${() => { clear(); leave(); }}>Back to now</button>` : html`<button type="button" class="primary" onClick=${() => openRobot(session.robot)}>Back in time</button>`}
    </div>
    ${!isPast && html`<${Losses} robot=${session.robot} show=${show} />`}
    ${isPast && html`<${Transport} robot=${robot} begin=${begin} setBegin=${setBegin} jump=${jump} />`}
    ${note && html`<p class="note" role="status">${note}</p>`}
    ${isPast && isByArrival && session.role === 'operator' && html`<p class="note">Labels and requests are by stamp.</p>`}
    ${isPast && !isByArrival && session.role === 'operator' && html`<${LabelForm} session=${session} robot=${robot} selected=${selected} clear=${clear} />`}
    ${isPast && !isByArrival && html`<${Pull} session=${session} robot=${robot} selected=${selected} />`}
    <div ref=${box} class="timeline-box">
      ${problem && html`<p class="note bad" role="alert">${problem}</p>`}
      ${isPast && found?.problem && html`<p class="note watch">${found.problem}</p>`}
      ${!problem && found && !topics.length && html`<p class="empty">Nothing was recorded in this time.</p>`}
      ${topics.length > 0 && html`<svg width=${width} height=${height} tabindex="0" role="slider" aria-label="Time: click or arrow keys show a moment, plus and minus zoom, brackets select a time, n and p go to gaps, e to events; the table below has all gaps"
          aria-valuemin=${Math.round(from)} aria-valuemax=${Math.round(to)} aria-valuenow=${Math.round(at)} aria-valuetext=${moment(at)}
          onPointerDown=${down} onPointerMove=${move} onPointerUp=${up} onPointerCancel=${() => { drag.current = null; }} onKeyDown=${key}>
        <defs><pattern id="unknown" width="6" height="6" patternUnits="userSpaceOnUse" patternTransform="rotate(45)">
          <rect class="unknown-back" width="6" height="6" /><rect class="unknown-line" width="2" height="6" /></pattern><${Patterns} shades=${shades} /></defs>
        <rect class="axis" x=${left} y=${height - AXIS} width=${Math.max(0, width - left - 8)} height=${AXIS} />
        ${ticks(from, to, Math.min(8, Math.max(1, (width - left) / TICK))).map((each) => html`<g><line class="tick" x1=${x(each)} x2=${x(each)} y1="0" y2=${height - AXIS} />
          <text class="tick-label" x=${x(each)} y=${height - 7}>${clock(each, to - from < 600000)}</text></g>`)}
        ${marks.map((mark) => html`<g class=${`mark-of-${mark.kind}`} data-mark=${mark.kind} data-from=${mark.from} data-to=${mark.to} data-name=${mark.name} transform=${`translate(0 ${mark.lane * LANE})`}>
          <title>${`${mark.kind} ${mark.name}${mark.text ? ` (${mark.text})` : ''}, ${clock(mark.from)}`}</title>
          ${mark.kind === 'event' ? html`<path d=${`M${x(mark.from)} 2l6 6l-6 6l-6-6z`} />`
            : html`<rect x=${x(mark.from)} y="1" width=${Math.max(3, x(mark.to) - x(mark.from))} height=${LANE - 3} rx="3" />
              <text x=${x(mark.from) + 4} y="12">${mark.name.length > 22 ? `${mark.name.slice(0, 21)}…` : mark.name}</text>`}</g>`)}
        ${body}
        ${deliveries.length > 0 && html`<g transform=${`translate(0 ${top + topics.length * ROW})`}><text class="row-label" x="0" y=${ROW / 2 + 4}><title>What was delivered late, or waits on the robot</title>delivery</text>
          ${deliveries.map((each, number) => isSeen(each[0], each[1]) && html`<rect class=${each[2] === null ? 'waits' : 'late'} data-late=${number} data-from=${each[0]} data-to=${each[1]} data-delivered=${each[2] ?? ''}
            x=${x(each[0])} y="7" width=${Math.max(2.5, x(each[1]) - x(each[0]))} height=${ROW - 14} rx="2"><title>${wait(each)}</title></rect>`)}</g>`}
        ${battery.length > 0 && html`<g transform=${`translate(0 ${top + (rows - 1) * ROW})`} class="battery"><text class="row-label" x="0" y=${ROW / 2 + 4}><title>The charge of the battery, from 0 to 100 %</title>battery ${Math.round(chargeAt(battery, at) ?? 0)} %</text>
          <line x1=${left} x2=${width - 8} y1=${ROW - 4} y2=${ROW - 4} /><path data-battery=${battery.length} d=${battery.filter(([each]) => isSeen(each, each)).map(([each, percent], place) => `${place ? 'L' : 'M'}${x(each).toFixed(1)} ${(ROW - 4 - (Math.min(100, Math.max(0, percent)) / 100) * (ROW - 8)).toFixed(1)}`).join('')} /></g>`}
        ${now < to && now > from && html`<line class="now" x1=${x(now)} x2=${x(now)} y1="0" y2=${height - AXIS} />`}
        ${selected && html`<g class="selection"><rect class="span" x=${x(selected[0])} y="0" width=${Math.max(1, x(selected[1]) - x(selected[0]))} height=${height - AXIS} />
          ${['from', 'to'].map((edge, place) => selected[place] >= from && selected[place] <= to && html`<rect class="edge" data-edge=${edge} x=${x(selected[place]) - 3} y="0" width="6" height=${height - AXIS} rx="2" />`)}</g>`}
        ${isPast && at >= from && at <= to && html`<g class="cursor"><line x1=${x(at)} x2=${x(at)} y1="0" y2=${height - AXIS} /><circle cx=${x(at)} cy=${height - AXIS} r="6" /></g>`}
      </svg>`}
    </div>
    ${selected && html`<${Selected} selected=${selected} clear=${clear} />`}
    <div class="legend">
      ${isPast && html`<span title="Objects of this topic are stored or wait for the store"><i class="swatch recorded"></i>recorded</span>`}
      ${kept.length > 0 && html`<span title="Only the robot has it; an operator can request it"><i class="swatch kept"></i>kept on the robot</span>`}
      <span title="The robot has accounted for every message of this time"><i class="swatch known"></i>nothing else is missing</span><span title="The robot has not reported that far, or was off"><i class="swatch unknown"></i>not known yet</span>
      ${deliveries.length > 0 && html`<span title="It reached the store more than half a minute after it was recorded"><i class="swatch late"></i>delivered late</span><span title="It is on the robot and waits for the store"><i class="swatch waits"></i>waits</span>`}
      ${[...seen.values()].map((each) => html`<span title=${`Messages that are lost: ${[...each.kinds].join(', ')} (${each.cause || 'unknown'})`}><${Swatch} cause=${each.cause} />${meaning(each.cause)} <b>${digits(each.messages)}</b></span>`)}
      ${['mission', 'bag', 'event', 'label'].filter((kind) => marks.some((mark) => mark.kind === kind)).map((kind) => html`<span title=${MARKED[kind]}><i class=${`swatch of-${kind}`}></i>${kind}</span>`)}
      ${found && !gaps.length && topics.length > 0 && html`<span class="good">no gap is known in this time</span>`}
      ${topics.length > 0 && html`<span class="unit">${isPast ? 'click: that moment · wheel: zoom · drag: move · shift-drag: select' : 'click on a time to see it again'}</span>`}
    </div>
    ${chosen && html`<${GapWords} gap=${chosen} swatch=${html`<${Swatch} cause=${chosen.cause} />`}>
      <p class="row"><button type="button" onClick=${() => show(chosen)}>Show the moment before</button>${isPast && html`<button type="button" onClick=${() => { setBegin(null); selection.value = { from: chosen.from, to: chosen.to }; }}>Select this time</button>`}</p></${GapWords}>`}
    ${late && html`<p class="chosen" aria-live="polite" data-late-words>Recorded ${clock(late[0])} to ${clock(late[1])}, ${late[2] === null ? 'and some of it still waits on the robot' : html`and delivered until ${clock(late[2])}, up to ${span((late[2] - late[0]) / 1000)} later`}: the store could not be reached then, or uploads had to wait. It waited on the robot's disk; what is lost is drawn as a gap.</p>`}
    ${isPast && html`<${Commands} session=${session} robot=${robot} selected=${selected} />`}
    ${gaps.length > 0 && html`<details><summary>${gaps.length === 1 ? 'The gap' : `All ${gaps.length} gaps`} as a table</summary><div class="scroll"><table class="gaps-table"><thead><tr><th title="The topic whose messages are missing">Topic</th><th title="The start of the gap, UTC; a click shows the moment before">From</th><th class="n" title="How long the gap is">For</th>
      <th class="n" title="How many messages are missing; an estimate if they are not numbered">Messages</th><th title="Where they were lost: missed on the way to the node; dropped or rejected in it; evicted from its disk, or in quarantine there">What</th><th title="Why they are missing">Cause</th></tr></thead><tbody>${gaps.slice(-500).map((gap) => html`<tr><td>${gap.topic}</td><td><button type="button" class="link" onClick=${() => show(gap)}>${clock(gap.from)}</button></td>
      <td class="n">${span((gap.to - gap.from) / 1000)}</td><td class="n">${digits(gap.count)}</td><td>${gap.kind}</td><td title=${gap.cause}>${meaning(gap.cause)}</td></tr>`)}</tbody></table></div></details>`}
  </div>${isPast && !session.has_live && robots.value.length === 1 && html`<${Fleet} chosen=${robot} names=${robots.value} />`}`;
}
