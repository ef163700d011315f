// Today by topic: what the journal knows, every gap at its time in the colour of its cause, and where nothing is known yet.
import { html, useEffect, useRef, useState } from './vendor/preact.js';
import { CAUSES, clock, digits, hue, span } from './words.js';

const SPANS = [[15, '15 min'], [60, '1 h'], [360, '6 h'], [0, 'Today']];
const EVERY_MS = 5000;
const ROW = 26;

function ticks(from, to) {
  const steps = [60, 120, 300, 600, 1800, 3600, 7200, 10800].map((seconds) => seconds * 1000);
  const step = steps.find((each) => (to - from) / each <= 8) ?? 14400000;
  const found = [];
  for (let at = Math.ceil(from / step) * step; at < to; at += step) found.push(at);
  return found;
}

export function Timeline() {
  const [minutes, setMinutes] = useState(60);
  const [found, setFound] = useState(null);
  const [problem, setProblem] = useState('');
  const [chosen, setChosen] = useState(null);
  const [width, setWidth] = useState(800);
  const box = useRef(null);

  useEffect(() => {
    let isOver = false;
    const load = async () => {
      if (document.hidden) return;
      const now = found?.now ?? Date.now();
      const asked = minutes ? `?from=${Math.round(now + EVERY_MS - minutes * 60000)}&to=${Math.round(now + EVERY_MS)}` : '';
      try {
        const answer = await fetch(`/api/gaps${asked}`);
        const content = await answer.json();
        if (isOver) return;
        if (answer.ok) setFound(content);
        setProblem(answer.ok ? '' : content.error);
      } catch {
        if (!isOver) setProblem('the robot cannot be reached');
      }
    };
    load();
    const timer = setInterval(load, minutes ? EVERY_MS : 3 * EVERY_MS);
    return () => {
      isOver = true;
      clearInterval(timer);
    };
  }, [minutes]);

  useEffect(() => {
    const seen = new ResizeObserver(([entry]) => setWidth(entry.contentRect.width));
    seen.observe(box.current);
    return () => seen.disconnect();
  }, []);

  const gaps = (found?.gaps ?? []).map((row) => Object.fromEntries(found.columns.map((name, place) => [name, row[place]])));
  const topics = [...new Set([...(found?.known ?? []).map(([topic]) => topic), ...gaps.map((gap) => gap.topic)])].sort();
  const left = width < 520 ? 92 : 150;
  const { from = 0, to = 1, now = 0 } = found ?? {};
  const x = (ms) => left + ((Math.min(Math.max(ms, from), to) - from) / (to - from)) * (width - left - 8);
  const height = topics.length * ROW + 26;
  const seen = new Map();
  for (const gap of gaps) {
    const name = `${gap.kind} ${gap.cause}`;
    const known = seen.get(name) ?? { ...gap, messages: 0, rows: 0 };
    known.messages += gap.count;
    known.rows += 1;
    seen.set(name, known);
  }

  return html`<div class="panel timeline">
    <div class="panel-head">
      <h3>${minutes ? `The last ${SPANS.find(([each]) => each === minutes)[1]}` : 'Today'} <span class="unit">UTC</span></h3>
      <div class="tabs" role="group" aria-label="How long">
        ${SPANS.map(([each, label]) => html`<button type="button" aria-pressed=${each === minutes} onClick=${() => setMinutes(each)}>${label}</button>`)}
      </div>
    </div>
    <div ref=${box} class="timeline-box">
      ${problem && html`<p class="empty">${problem}</p>`}
      ${!problem && found && !topics.length && html`<p class="empty">Nothing was recorded in this time.</p>`}
      ${topics.length > 0 && html`<svg width=${width} height=${height} role="img" aria-label="Gaps by topic and time; the table below has them all">
        <defs><pattern id="unknown" width="6" height="6" patternUnits="userSpaceOnUse" patternTransform="rotate(45)">
          <rect class="unknown-back" width="6" height="6" /><rect class="unknown-line" width="2" height="6" /></pattern></defs>
        ${ticks(from, to).map((at) => html`<g><line class="tick" x1=${x(at)} x2=${x(at)} y1="0" y2=${height - 22} />
          <text class="tick-label" x=${x(at)} y=${height - 6}>${clock(at, false)}</text></g>`)}
        ${topics.map((topic, place) => html`<g transform=${`translate(0 ${place * ROW})`}>
          <text class="row-label" x="0" y=${ROW / 2 + 4}><title>${topic}</title>${topic.length > (left - 12) / 6.6 ? `…${topic.slice(-Math.floor((left - 18) / 6.6))}` : topic}</text>
          <rect class="unknown" x=${left} y="5" width=${Math.max(0, x(now) - left)} height=${ROW - 10} rx="3" fill="url(#unknown)"><title>not known (yet)</title></rect>
          ${found.known.filter(([name]) => name === topic).map(([, since, until]) => html`<rect class="known" data-topic=${topic} data-from=${since} data-to=${until}
            x=${x(since)} y="5" width=${Math.max(1, x(until) - x(since))} height=${ROW - 10} rx="3" />`)}
          ${gaps.filter((gap) => gap.topic === topic).map((gap) => html`<rect class=${`gap hue-${hue(gap.kind, gap.cause)}`} data-topic=${topic} data-kind=${gap.kind}
            data-cause=${gap.cause} data-from=${gap.from} data-to=${gap.to} data-count=${gap.count} x=${x(gap.from)} y="3"
            width=${Math.max(2.5, x(gap.to) - x(gap.from))} height=${ROW - 6} rx="1.5" onPointerEnter=${() => setChosen(gap)}>
            <title>${`${topic}: ${gap.count} ${gap.kind} (${gap.cause}), ${clock(gap.from)} for ${span((gap.to - gap.from) / 1000)}`}</title></rect>`)}
        </g>`)}
        ${now < to && html`<line class="now" x1=${x(now)} x2=${x(now)} y1="0" y2=${height - 22} />`}
      </svg>`}
    </div>
    <div class="legend">
      <span><i class="swatch known"></i>complete</span><span><i class="swatch unknown"></i>not known yet</span>
      ${[...seen.values()].map((each) => html`<span title=${CAUSES[each.cause] ?? ''}><i class=${`swatch hue-${hue(each.kind, each.cause)}`}></i>${each.kind}: ${each.cause.replaceAll('_', ' ')} <b>${digits(each.messages)}</b></span>`)}
      ${found && !gaps.length && topics.length > 0 && html`<span class="good">no gap in this time</span>`}
    </div>
    ${chosen && html`<p class="chosen" aria-live="polite"><i class=${`swatch hue-${hue(chosen.kind, chosen.cause)}`}></i><b>${chosen.topic}</b> ${digits(chosen.count)} messages
      ${chosen.kind}, ${CAUSES[chosen.cause] ?? chosen.cause.replaceAll('_', ' ')}: from ${clock(chosen.from)} for ${span((chosen.to - chosen.from) / 1000)}${chosen.grade === 'exact' ? '' : ' (estimated)'}</p>`}
    ${gaps.length > 0 && html`<details><summary>All ${gaps.length} gaps as a table</summary><div class="scroll"><table><thead><tr><th>Topic</th><th>From</th><th class="n">For</th>
      <th class="n">Messages</th><th>What</th><th>Cause</th></tr></thead><tbody>${gaps.slice(-500).map((gap) => html`<tr><td>${gap.topic}</td><td>${clock(gap.from)}</td>
      <td class="n">${span((gap.to - gap.from) / 1000)}</td><td class="n">${digits(gap.count)}</td><td>${gap.kind}</td><td>${gap.cause.replaceAll('_', ' ')}</td></tr>`)}</tbody></table></div></details>`}
  </div>`;
}
