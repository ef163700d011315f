// Figures in words, the same all over the page.
import { html } from './vendor/preact.js';

const UNITS = ['B', 'KB', 'MB', 'GB', 'TB'];

export function volume(bytes) {
  if (bytes === null || bytes === undefined) return '–';
  let unit = 0;
  for (; bytes >= 1000 && unit < UNITS.length - 1; unit += 1) bytes /= 1000;
  return `${unit && bytes < 100 ? bytes.toFixed(1) : Math.round(bytes)} ${UNITS[unit]}`;
}

export function span(seconds) {
  if (seconds === null || seconds === undefined || !isFinite(seconds)) return '–';
  if (seconds < 10) return `${seconds.toFixed(1)} s`;
  if (seconds < 90) return `${Math.round(seconds)} s`;
  if (seconds < 5400) return `${Math.round(seconds / 60)} min`;
  if (seconds < 172800) return `${(seconds / 3600).toFixed(1)} h`;
  return `${Math.round(seconds / 86400)} d`;
}

// In groups of three that only the eye sees: the text is the plain number.
export function digits(number) {
  if (number === null || number === undefined) return '–';
  const text = String(number);
  const groups = [];
  for (let end = text.length; end > 0; end -= 3) groups.unshift(text.slice(Math.max(0, end - 3), end));
  return groups.map((group, place) => html`<span class=${place ? 'group' : ''}>${group}</span>`);
}

export const clock = (ms, seconds = true) => new Date(ms).toISOString().slice(11, seconds ? 19 : 16);

export const moment = (ms) => `${new Date(ms).toISOString().slice(0, 10)} ${new Date(ms).toISOString().slice(11, 21)}`;

// Of each cause what it means, and how gaps of it look: a hue, and what is drawn in it. No two look the same.
const CAUSES = {
  transport: ['Lost on the way to the node', 'red', 'solid'], silence: ['No message for longer than usual', 'sky', 'solid'], restart: ['The node was not running', 'purple', 'solid'],
  paused: ['The node was paused', 'blue', 'solid'], queue_full: ['The queue was full', 'yellow', 'solid'], no_room: ['The disk was full', 'brown', 'solid'],
  damaged: ['The file in the spool was damaged', 'ink', 'solid'], keep_limit: ['More was kept than keep.max_bytes allows', 'pink', 'solid'], unknown: ['Unknown cause', 'gray', 'solid'],
  ring_full: ['The ring of events was full', 'yellow', 'bands'], unwritable: ['The disk could not be written', 'brown', 'bands'], shutdown: ['The node stopped before they were stored', 'purple', 'bands'],
  stopped: ['The bag had ended', 'purple', 'stripes'], keep_days: ['They were kept for long enough', 'pink', 'bands'], thinned: ['Space ran short: others of that time are kept', 'pink', 'stripes'],
  retention: ['Removed from the store by a rule', 'pink', 'dots'], sampler_failed: ['The node failed to sort them', 'red', 'bands'], encoder_failed: ['The node failed to encode them', 'red', 'stripes'],
  unsafe_key: ['Their key cannot be stored', 'red', 'dots'], wrong_type: ['Messages of another type', 'blue', 'bands'], unknown_type: ['The type is not known to the node', 'blue', 'stripes'],
  unknown_field: ['The type has no such field', 'blue', 'dots'], surplus: ['The format holds one message', 'blue', 'checks'], malformed: ['The messages were invalid', 'sky', 'bands'],
  size_mismatch: ['Their sizes contradict one another', 'sky', 'stripes'], too_large: ['The images were too large', 'sky', 'dots'], empty: ['They were empty', 'sky', 'checks'],
  unsupported_encoding: ['Their encoding is not supported', 'yellow', 'stripes'], missing: ['The file in the spool is gone', 'ink', 'bands'], foreign: ['Another object has their key', 'ink', 'stripes'],
  access_denied: ['The store denied them', 'ink', 'dots'], refused: ['The store refused them', 'ink', 'checks'], name: ['The store cannot have their name', 'brown', 'stripes'],
  size: ['They were larger than the store accepts', 'brown', 'dots'], changed: ['They changed while they were sent', 'brown', 'checks'],
};
const PATTERNS = ['solid', 'bands', 'stripes', 'dots', 'checks'];
const taken = Object.values(CAUSES).map(([, hue, pattern]) => `${hue} ${pattern}`);
const HUES = [...new Set(Object.values(CAUSES).map(([, hue]) => hue))];
const free = PATTERNS.flatMap((pattern) => HUES.map((hue) => [hue, pattern])).filter((each) => !taken.includes(each.join(' ')));
const others = new Map(); // what a server calls it, say: as they come, each its own look while there are any

const known = (cause) => (Object.hasOwn(CAUSES, cause || 'unknown') ? CAUSES[cause || 'unknown'] : null);

export function shade(cause) {
  if (!known(cause) && !others.has(cause)) others.set(cause, free[others.size % free.length]);
  return known(cause)?.slice(1) ?? others.get(cause);
}

export const meaning = (cause) => known(cause)?.[0] ?? cause.replaceAll('_', ' ');
