// A link to a moment: the part of the address after # names the robot and the time that are shown.
import { go, list, look, past, range } from './past.js';
import { session } from './state.js';

const AROUND_MS = 450000;
const WRITE_MS = 400; // browsers refuse addresses that change more often
const named = () => new URLSearchParams(location.hash.slice(1));

let timer;
let wasPast = false;
export function toAddress(now) {
  if (!now && !wasPast) return; // the address of a page that has just been opened is read, not written
  wasPast = true;
  clearTimeout(timer);
  timer = setTimeout(() => {
    const shown = past.value;
    const wanted = shown ? `#${new URLSearchParams({ robot: shown.robot, at: new Date(shown.at).toISOString() })}` : named().has('at') ? '' : location.hash;
    if (wanted !== location.hash) history.replaceState(null, '', `${location.pathname}${wanted}`);
  }, WRITE_MS);
}

// Show the moment that the address names, if it names one.
export async function fromAddress() {
  const asked = named();
  const at = Date.parse(asked.get('at') ?? '');
  if (!Number.isFinite(at)) return false;
  const robot = asked.get('robot') || session.value?.robot;
  await list(robot);
  go(robot, at);
  if (!range.value) look(robot, at - AROUND_MS, at + AROUND_MS);
  return true;
}

addEventListener('hashchange', fromAddress);
