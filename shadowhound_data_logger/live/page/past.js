// Back in time: which moment is shown, what the robot recorded then, and playing on from there.
import { batch, signal } from './vendor/preact.js';

const PIECE_MS = 250;

export const past = signal(null); // null: now; else { robot, at, mission, shown, commands }
export const range = signal(null); // what the timeline shows of the past: { robot, from, to }
export const told = signal(null); // the timeline's answer
export const problem = signal('');
export const busy = signal(false);
export const playing = signal(false);
export const speed = signal(1);
export const robots = signal([]);
export const days = signal([]);

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

let wanted = null;
let asking = false;
async function load() {
  if (asking) return;
  asking = true;
  while (wanted) {
    const { robot, at } = wanted;
    wanted = null;
    busy.value = true;
    try {
      const [head, items] = parts(await (await ask('moment', { robot, at: Math.round(at) })).arrayBuffer());
      if (past.value === null) break;
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

export function leave() {
  batch(() => {
    past.value = range.value = told.value = wanted = null;
    playing.value = false;
    problem.value = '';
  });
}

let loading = 0;
export async function look(robot, from, to) {
  const mine = (loading += 1);
  range.value = { robot, from, to };
  try {
    const found = await (await ask('timeline', { robot, from: Math.round(from), to: Math.round(to) })).json();
    if (mine !== loading || range.value === null) return;
    told.value = found;
    problem.value = '';
  } catch (error) {
    if (mine === loading) problem.value = reason(error);
  }
}

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
  await look(robot, from, from + DAY_MS);
  const { recorded = [], kept = [] } = told.value ?? {};
  const last = [...recorded, ...kept].reduce((most, [, , to]) => Math.max(most, to), 0);
  go(robot, last || from + DAY_MS / 2);
}

export async function openRobot(robot) {
  const chosen = await list(robot);
  if (chosen === null) return;
  if (days.value.length) await openDay(chosen, days.value[0]);
  else problem.value = `nothing of ${chosen} is stored yet`;
}

let lastAt = 0;
setInterval(() => {
  const now = performance.now();
  const passed = Math.min(1000, now - lastAt);
  lastAt = now;
  if (!playing.value || !past.value || document.hidden || asking) return;
  const at = past.value.at + passed * speed.value;
  const end = Math.min(range.value?.to ?? at, told.value?.now ?? at);
  if (at >= end) playing.value = false;
  go(past.value.robot, Math.min(at, end));
}, PIECE_MS);
