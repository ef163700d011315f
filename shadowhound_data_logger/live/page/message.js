// The newest message of a topic as a tree; a click on a number of it plots it.
import { html, signal, useState } from './vendor/preact.js';
import { MOST_PLOTS, change, layout, problems, topics, useItems, useWatch } from './state.js';
import { span, volume } from './words.js';
import { present } from './state.js';

export const inspected = signal(null); // the topic
export const measured = signal({}); // topic -> what its newest message told: { bytes, hz, at }
const DEEPEST = 24;
const OPEN_DEPTH = 3; // deeper ones are opened by a click

const plotted = (key) => layout.value.plots.includes(key);
function plot(key) {
  const { plots } = layout.value;
  change({ plots: plotted(key) ? plots.filter((each) => each !== key) : [...plots, key].slice(-MOST_PLOTS) });
}

function Value({ value, path, topic }) {
  if (typeof value === 'number' || typeof value === 'boolean') {
    const key = `${topic}#${path}`;
    return html`<button type="button" class="value" aria-pressed=${plotted(key)} data-path=${path} title=${plotted(key) ? 'End its plot' : `Plot ${path}`} onClick=${() => plot(key)}>${String(value)}</button>`;
  }
  return html`<span class="text">${value === '' ? html`<small>(empty)</small>` : String(value)}</span>`;
}

// An element of an array that is not shown, by its number.
function Element({ path, topic, length }) {
  const submit = (event) => {
    event.preventDefault();
    plot(`${topic}#${path}[${Math.floor(Number(new FormData(event.target).get('index')))}]`);
  };
  return html`<form class="element" onSubmit=${submit}><input name="index" type="number" min="0" max=${length - 1} required aria-label=${`Element of ${path}`} placeholder=${`0–${length - 1}`} /><button>Plot element</button></form>`;
}

function Node({ node, path, topic, depth }) {
  if (node === null || typeof node !== 'object' || depth > DEEPEST) return html`<${Value} value=${node === null || typeof node !== 'object' ? node : '…'} path=${path} topic=${topic} />`;
  const isArray = Array.isArray(node.a);
  const rows = isArray ? node.a.map((each, place) => [`[${place}]`, each, `${path}[${place}]`]) : Object.entries(node.f ?? {}).map(([name, each]) => [name, each, path ? `${path}.${name}` : name]);
  if (!rows.length) return html`<span class="text"><small>${isArray ? '(no elements)' : '(no fields)'}</small></span>`;
  const isFlat = isArray && node.a.every((each) => each === null || typeof each !== 'object');
  const more = isArray ? node.n - node.a.length : 0;
  const content = html`${isFlat ? html`<div class="flat">${rows.map(([, each, at]) => html`<${Value} value=${each} path=${at} topic=${topic} />`)}${more > 0 ? html`<small>… ${more} more</small>` : ''}</div>`
    : html`<ul>${rows.map(([name, each, at]) => html`<li key=${name}><span class="name">${name}</span> <${Node} node=${each} path=${at} topic=${topic} depth=${depth + 1} /></li>`)}${more > 0 ? html`<li><small>… ${more} more</small></li>` : ''}</ul>`}
    ${isFlat && more > 0 && typeof node.a[0] === 'number' && html`<${Element} path=${path} topic=${topic} length=${node.n} />`}`;
  if (!path) return content;
  return html`<details open=${depth < OPEN_DEPTH}><summary><small>${String(node.t || '')}${isArray ? `[${node.n}]` : ''}</small></summary>${content}</details>`;
}

export function Message({ topic }) {
  const [head, setHead] = useState(null);
  const [isHeld, setIsHeld] = useState(false);
  const key = `${topic}#`;
  useWatch([], () => [key]);
  useItems('message', (now) => {
    if (now.topic !== key) return;
    measured.value = { ...measured.value, [topic]: { bytes: now.bytes, hz: now.hz ?? undefined, at: now.at } };
    setHead(now);
  });
  const [shown, setShown] = useState(null);
  if (!isHeld && shown !== head) setShown(head);
  const told = topics.value.find(([name]) => name === topic);
  const why = problems.value[key] || (!told ? 'This topic does not exist now.' : told[3] > 0 ? '' : 'Nobody publishes this now.');
  const age = present.value === null || !shown ? null : Math.max(0, present.value - shown.at) / 1e3;
  return html`<div class="message" data-message=${topic}><p class="row">${told && html`<code>${told[2]}</code>`}${shown && html`<span>${volume(shown.bytes)}</span>${shown.hz ? html`<span>${shown.hz.toFixed(1)} Hz</span>` : ''}${age !== null && html`<span>${span(age)} old</span>`}
    <button type="button" aria-pressed=${isHeld} onClick=${() => setIsHeld(!isHeld)} title="Keep this message on the page while newer ones come">Hold</button>`}<small>A click on a number plots it.</small></p>
    ${why && html`<p class="why" data-why=${key}>${why}</p>`}${shown ? html`<div class="tree"><${Node} node=${shown.tree} path="" topic=${topic} depth=${0} /></div>` : !why && html`<p class="empty">Waiting for a message …</p>`}</div>`;
}
