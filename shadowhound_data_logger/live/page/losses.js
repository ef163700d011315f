// What was lost since somebody said that the losses are seen: kept in this browser, for each robot.
import { html, signal, useEffect } from './vendor/preact.js';
import { clock, digits, meaning, moment, span } from './words.js';

const DAY_MS = 86400000;
const EVERY_MS = 15000;
const MOST_NAMED = 12;
export const losses = signal(null); // { since, now, topics: Map(topic -> messages), gaps }; null while it is unknown

const name = (robot) => `shadowhound.seen.${robot}`;
function seenAt(robot, now) {
  let at = NaN;
  try {
    at = Number(localStorage.getItem(name(robot)) ?? NaN);
  } catch { /* this browser keeps nothing */ }
  return Number.isFinite(at) && at > 0 && at <= now ? at : now - DAY_MS; // who never said so is told of a day
}

async function load(robot) {
  if (document.hidden) return;
  try {
    const now = losses.value?.now ?? Date.now();
    const since = seenAt(robot, now);
    const answer = await fetch(`/api/gaps?from=${Math.round(since)}&to=${Math.round(now + DAY_MS)}`);
    if (!answer.ok) return;
    const found = await answer.json();
    const gaps = found.gaps.map((row) => Object.fromEntries(found.columns.map((column, place) => [column, row[place]]))).filter((gap) => gap.sink === 'objects' && gap.to > since);
    const topics = new Map();
    for (const gap of gaps) topics.set(gap.topic, (topics.get(gap.topic) ?? 0) + gap.count);
    losses.value = { since, now: found.now, topics, gaps };
  } catch { /* the page says elsewhere that the robot cannot be reached */ }
}

// Messages of a topic that were lost and that nobody has seen yet; null while that is unknown.
export const unseen = (topic) => (losses.value ? losses.value.topics.get(topic) ?? 0 : null);

export function Losses({ robot, show }) {
  useEffect(() => {
    load(robot);
    const timer = setInterval(() => load(robot), EVERY_MS);
    return () => clearInterval(timer);
  }, [robot]);
  if (!losses.value) return null;
  const { since, now, topics, gaps } = losses.value;
  const acknowledge = () => {
    try {
      localStorage.setItem(name(robot), String(Math.round(now)));
    } catch { /* then only this page knows */ }
    losses.value = { since: now, now, topics: new Map(), gaps: [] };
  };
  const ago = now - since > DAY_MS ? `since ${moment(since).slice(0, 16)}` : `since ${clock(since, false)} (${span((now - since) / 1000)} ago)`;
  if (!gaps.length) return html`<p class="losses good" data-losses="0" title="As far as the node has reported: up to the end of the pale green bars">No loss is known ${ago}.</p>`;
  const names = [...topics.keys()].sort((one, other) => topics.get(other) - topics.get(one));
  const causes = [...new Set(gaps.map((gap) => gap.cause))];
  const messages = gaps.reduce((sum, gap) => sum + gap.count, 0);
  return html`<div class="losses" role="status" data-losses=${messages}><p><b>${digits(messages)} message${messages === 1 ? '' : 's'} lost</b> ${ago}: on ${names.slice(0, MOST_NAMED).map((topic, place) => html`${place ? ', ' : ''}<button type="button" class="link" data-lost=${topic} title="Show its first gap: when, and why" onClick=${() => show(gaps.find((gap) => gap.topic === topic))}>${topic}</button> (${digits(topics.get(topic))})`)}${names.length > MOST_NAMED ? ` and ${names.length - MOST_NAMED} more topics` : ''}. ${causes.slice(0, 3).map(meaning).join('; ')}.</p>
    <p class="row"><button type="button" onClick=${() => show(gaps[0])}>Show the first</button><button type="button" onClick=${acknowledge} title="They stay on the timeline and in the totals, and are no alarm any more in this browser">I have seen them</button></p></div>`;
}
