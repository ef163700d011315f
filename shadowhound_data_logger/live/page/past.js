// Back in time: which moment is shown, what the robot recorded then, and playing on from there.
import { batch, signal } from './vendor/preact.js';

const PIECE_MS = 125; // between two moments that are played, where they can be read that fast
const SLOWEST_MS = 1000; // what takes longer plays slower
const TICK_MS = 20;

export const past = signal(null); // null: now; else { robot, at, mission, shown, commands }
export const range = signal(null); // what the timeline shows of the past: { robot, from, to }
export const told = signal(null); // the timeline's answer
export const problem = signal('');
export const timelineProblem = signal('');
export const busy = signal(false);
export const playing = signal(false);
export const speed = signal(1);
export const clock = signal('stamp'); // by which of the two times of its messages a moment is shown: stamp, or received
export const robots = signal([]);
export const days = signal([]);
export const selection = signal(null); // a time that somebody marked: { from, to }
export const SHORTEST_MS = 2000;
export const LONGEST_MS = 48 * 3600000;

let onItems = () => {};
export function show(handler) {
  onItems = handler;
}

async function ask(what, more = {}) {
  const answer = await fetch(`/api/past/${what}?${new URLSearchParams(more)}`);
  if (!answer.ok) throw new Error((await answer.json()).error);
  return answer;
}

const reason = (error) => (error instanceof TypeError ? 'it cannot be reached' : error.message);

// The head, and the items: each after a uint32 with its length, as they come over the WebSocket.
function parts(content) {
  const view = new DataView(content);
  const text = new TextDecoder();
  const taken = (at) => text.decode(new Uint8Array(content, at + 4, view.getUint32(at, true)));
  const head = JSON.parse(taken(0));
  const items = [];
  for (let at = 4 + view.getUint32(0, true); at < content.byteLength;) {
    const length = view.getUint32(at, true);
    const headLength = view.getUint32(at + 4, true);
    items.push([JSON.parse(text.decode(new Uint8Array(content, at + 8, headLength))), new Uint8Array(content.slice(at + 8 + headLength, at + 4 + length))]);
    at += 4 + length;
  }
  return [head, items];
}

const read = async (robot, at) => parts(await (await ask('moment', { robot, at: Math.round(at), by: clock.value })).arrayBuffer());

// What the robot recorded lately: [item, body] as those of a moment, with the times of live items.
export const recent = async () => parts(await (await ask('recent')).arrayBuffer())[1];

let wanted = null;
let asking = false;
let ahead = null; // the moment that is played next, asked for while the one before it is shown: { robot, at, answer }
let shownAt = 0;
async function load() {
  if (asking) return;
  asking = true;
  while (wanted) {
    const { robot, at } = wanted;
    wanted = null;
    busy.value = true;
    try {
      const isNext = ahead?.robot === robot && ahead.at === at;
      const [head, items] = await (isNext ? ahead.answer : read(robot, at));
      if (past.value === null) break;
      if (playing.value && !wanted) askAhead(robot, at);
      batch(() => {
        past.value = { ...past.value, ...head, robot, at: wanted?.at ?? past.value.at, read: head.at };
        problem.value = '';
      });
      onItems(head, items);
    } catch (error) {
      problem.value = reason(error);
      playing.value = false;
    }
  }
  busy.value = false;
  asking = false;
}

export function go(robot, at) {
  past.value = { shown: [], commands: [], mission: '', ...past.value, robot, at };
  wanted = { robot, at };
  load();
}

export function showBy(chosen) {
  clock.value = chosen;
  ahead = null;
  if (range.value) look(range.value.robot, range.value.from, range.value.to);
  if (past.value) go(past.value.robot, past.value.at);
}

export function leave() {
  opening += 1;
  batch(() => {
    past.value = range.value = told.value = selection.value = wanted = sought = null;
    playing.value = false;
    problem.value = timelineProblem.value = '';
  });
}

export async function timeline(robot, from, to, more = {}) {
  return (await ask('timeline', { robot, from: Math.round(from), to: Math.round(to), by: clock.value, ...more })).json();
}

export async function spanOf(robot, from, to) {
  return (await ask('range', { robot, from: Math.round(from), to: Math.round(to), by: clock.value })).json();
}

const AGAIN_MS = 3000;
const MOST_TRIES = 3;
let sought = null; // the range that is asked for next: however fast somebody zooms, one question is open at a time
let seeking = null;
async function seek() {
  while (sought) {
    const { robot, from, to, more, tries } = sought;
    sought = null;
    try {
      const found = await timeline(robot, from, to, more);
      if (range.value === null) return;
      batch(() => {
        if (more.fit && !sought) range.value = { robot, from: found.from, to: found.to };
        told.value = { ...found, robot };
        timelineProblem.value = '';
      });
      if (found.labels) setTimeout(() => { if (range.value && !sought) look(range.value.robot, range.value.from, range.value.to); }, 1000);
    } catch (error) {
      if (sought) continue;
      timelineProblem.value = reason(error);
      const asked = range.value;
      if (tries < MOST_TRIES) setTimeout(() => { if (range.value === asked && asked !== null) look(robot, from, to, more, tries + 1); }, AGAIN_MS);
    }
  }
}

export function look(robot, from, to, more = {}, tries = 0) {
  range.value = { robot, from, to };
  sought = { robot, from, to, more, tries };
  seeking ??= seek().finally(() => { seeking = null; });
  return seeking;
}

// The same length, or another, around a place that stays where it is.
export function zoom(at, factor) {
  const { robot, from, to } = range.value;
  const length = Math.min(LONGEST_MS, Math.max(SHORTEST_MS, (to - from) * factor));
  const begin = at - ((at - from) / (to - from)) * length;
  look(robot, begin, begin + length);
}

export function pan(ms) {
  const { robot, from, to } = range.value;
  look(robot, from + ms, to + ms);
}

export const fleet = async () => (await (await ask('fleet')).json()).fleet;

export async function list(robot) {
  try {
    robots.value = (await (await ask('robots')).json()).robots;
    const chosen = robots.value.includes(robot) ? robot : robots.value[0] ?? robot;
    days.value = (await (await ask('days', { robot: chosen })).json()).days.reverse();
    return chosen;
  } catch (error) {
    problem.value = reason(error);
    return null;
  }
}

const DAY_MS = 86400000;
export async function openDay(robot, day) {
  const from = Date.parse(`${day}T00:00:00Z`);
  await look(robot, from, from + DAY_MS, { fit: 1 });
  const { recorded = [], kept = [] } = told.value ?? {};
  const last = [...recorded, ...kept].reduce((most, [, , to]) => Math.max(most, to), 0);
  go(robot, last || from + DAY_MS / 2);
}

let opening = 0;
export async function openRobot(robot) {
  const mine = (opening += 1);
  const chosen = await list(robot);
  if (chosen === null) { // the process that reads the past may take long to start on a busy machine
    setTimeout(() => { if (mine === opening) openRobot(robot); }, AGAIN_MS);
  } else if (days.value.length) await openDay(chosen, days.value[0]);
  else problem.value = `nothing of ${chosen} is stored yet`;
}

const end = () => Math.min(range.value?.to ?? Infinity, told.value?.now ?? Infinity);

// The moment after this one, which is as far from it as the last one took to come.
function askAhead(robot, at) {
  const now = performance.now();
  const passed = Math.min(SLOWEST_MS, Math.max(PIECE_MS, now - shownAt));
  shownAt = now;
  const next = Math.min(at + passed * speed.value, end());
  ahead = { robot, at: next, answer: read(robot, next) };
  ahead.answer.catch(() => {}); // whoever waits for it is told; nobody may
}

function play() {
  if (!past.value || document.hidden || asking) return;
  if (!ahead) askAhead(past.value.robot, past.value.at);
  if (performance.now() < shownAt + PIECE_MS) return;
  const { robot, at } = ahead;
  if (at >= end()) playing.value = false;
  go(robot, at);
}

let player;
playing.subscribe((isOn) => {
  clearInterval(player);
  ahead = null;
  shownAt = performance.now();
  if (isOn) player = setInterval(play, TICK_MS);
});
