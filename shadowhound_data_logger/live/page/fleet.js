// All robots of a store, those that need a look first.
import { html, useEffect, useState } from './vendor/preact.js';
import { Mark } from './data.js';
import { fleet, openRobot } from './past.js';
import { digits, meaning, moment, span } from './words.js';

const EVERY_MS = 60000;
const unknown = (robot) => ({ robot, state: 'none', why: '…', last: null, last_date: '…', mission: '', mission_at: null, lost: null, causes: [], known: null });

// `names`: of the robots, which are known before all else is, so that the page does not move when that comes.
export function Fleet({ chosen, names }) {
  const [rows, setRows] = useState(null);
  const [failed, setFailed] = useState('');
  useEffect(() => {
    let isOver = false;
    const load = () => !document.hidden && fleet().then((found) => { if (!isOver) { setRows(found); setFailed(''); } }, (error) => !isOver && setFailed(error.message));
    const first = setTimeout(load, 1500); // the moment that is shown goes first
    const timer = setInterval(load, EVERY_MS);
    return () => {
      isOver = true;
      clearTimeout(first);
      clearInterval(timer);
    };
  }, []);
  if (failed) return html`<div class="panel fleet"><p class="note bad" role="alert">${failed}</p></div>`;
  const now = Date.now();
  const ago = (ms) => (ms === null ? '–' : `${span(Math.max(0, now - ms) / 1000)} ago`);
  return html`<div class="panel fleet"><div class="panel-head"><h3 title="All robots that have delivered to this store">Robots</h3><span class="unit">what needs a look is first</span></div><div class="scroll"><table>
    <thead><tr><th title="Whether the robot needs a look; each mark explains itself"><span class="visually-hidden">State</span></th><th title="A click shows what this robot recorded last">Robot</th><th title="When the newest message in the store came to the robot">Last contact</th><th title="The last mission in the store, and when it started">Last mission</th>
      <th class="n" title="Messages that are known to be lost since midnight, UTC">Missing today</th><th title="Up to here the robot has reported what is missing. What is newer still waits on the robot.">Known until</th></tr></thead>
    <tbody>${(rows ?? names.map(unknown)).map((row) => html`<tr key=${row.robot} class=${row.robot === chosen ? 'shown' : ''} data-robot=${row.robot} data-state=${rows ? row.state : 'unknown'}><td><${Mark} kind=${row.state} why=${row.why} /></td>
      <td><button type="button" class="link" onClick=${() => openRobot(row.robot)}>${row.robot}</button><small> ${row.state === 'good' ? '' : row.why}</small></td>
      <td class="figure" title=${`When the newest message in the store came to the robot${row.last === null ? '' : `: ${moment(row.last)}`}`}>${row.last === null ? row.last_date || 'never' : ago(row.last)}</td>
      <td class="figure" title="The last mission in the store, and when it started">${row.mission || '–'}${row.mission_at === null ? '' : html` <small>${ago(row.mission_at)}</small>`}</td>
      <td class=${`n ${row.lost ? 'lossy' : ''}`} data-field="lost" title=${`Messages that are known to be lost since midnight, UTC${row.causes.map(([cause, count], place) => `${place ? ', ' : ': '}${meaning(cause)} ${count}`).join('')}`}>${digits(row.lost)}</td><td class="figure" title=${`Up to here the robot has reported what is missing${row.known === null ? '' : `: ${moment(row.known)}`}`}>${ago(row.known)}</td></tr>`)}</tbody></table></div></div>`;
}
