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

export const CAUSES = {
  restart: 'The node was not running', transport: 'Lost on the way to the node', no_room: 'The disk was full', queue_full: 'The queue was full',
  paused: 'The node was paused', unknown: 'Of unknown cause',
};
const HUES = { restart: 'violet', transport: 'red', paused: 'blue', no_room: 'orange', queue_full: 'orange', unknown: 'grey' };
const KINDS = { dropped: 'orange', rejected: 'pink', evicted: 'brown', quarantined: 'brown', missed: 'red' };
export const hue = (kind, cause) => HUES[cause] || KINDS[kind] || 'grey';
