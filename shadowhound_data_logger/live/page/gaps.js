// A gap in words: what was lost, why, and what to do about it.
import { html } from './vendor/preact.js';
import { clock, digits, meaning, span } from './words.js';

const LOOK = 'They cannot be restored.';
const SETTINGS = 'docs/parameters.md has the setting.';
const REMEDIES = {
  transport: 'The network or the middleware dropped them before the node got them: ask the doctor about the receive buffer (net.core.rmem_max), or publish with the reliability RELIABLE.',
  silence: 'No message was published for longer than usual: look at the driver of this sensor at that time.',
  restart: 'Look in the log of the node for why it stopped: journalctl -u shadowhound-data-logger. Messages that were published during that time did not reach it.',
  paused: 'An operator or a program paused the node. The log says who.',
  queue_full: `The computer was too busy to keep up: lower the rate of large topics, or raise queue.max_messages. ${SETTINGS}`,
  no_room: `The disk was full: raise spool.max_bytes, free disk space, or log less. ${SETTINGS}`,
  damaged: 'The disk or a power cut damaged the file: check the disk (dmesg, smartctl).',
  keep_limit: `Pull what you need sooner, or raise keep.max_bytes. ${SETTINGS}`,
  keep_days: `Pull what you need sooner, or raise keep.days. ${SETTINGS}`,
  thinned: 'Space ran short, and every second object of that time was deleted: pull sooner, or raise keep.max_bytes.',
  ring_full: 'The ring of events held more than its limit: raise events.max_bytes, or choose fewer topics for events.',
  unwritable: 'The disk could not be written: check that it is mounted, writable and not full.',
  shutdown: 'The node was stopped before they were on the disk: give it more time to stop.',
  stopped: 'The bag had ended. Start it earlier, or stop it later.',
  retention: 'A rule of the store removed them: shadowhound-data lake prune lists the rules.',
  sampler_failed: 'A fault in the node: its log has the reason. Please report it.',
  encoder_failed: 'A fault in the node: its log has the reason. Please report it.',
  unsafe_key: 'The name of the topic or sensor cannot be part of a key: choose another name for the sensor.',
  wrong_type: 'Another type was published under this name: ros2 topic info -v shows by which node.',
  unknown_type: 'Source the workspace that has this type before the node starts.',
  unknown_field: 'A setting names a field that the type does not have: correct the setting.',
  surplus: 'More messages came than the format holds: choose another format for this sensor.',
  malformed: 'The publisher sent invalid messages: look at the driver.',
  size_mismatch: 'The publisher sent sizes that contradict one another: look at the driver.',
  too_large: 'They were larger than the limit: send smaller ones, or log them in a bag.',
  empty: 'The publisher sent messages without content: look at the driver.',
  unsupported_encoding: 'Publish them in another encoding, or as CompressedImage, or log them in a bag.',
  missing: 'The file was removed from the spool: only the node may change that folder.',
  foreign: 'Another object has this key in the store: it is kept in the quarantine. Do two robots have the same name?',
  access_denied: 'The store does not let this robot write there: check its credentials, then release the quarantine with shadowhound-data spool retry.',
  refused: 'The store refused them: they are in the quarantine, with the reason. shadowhound-data spool list shows it.',
  name: 'The store cannot have such a name: choose another name for the robot or the sensor.',
  size: 'They are larger than the store takes: raise its limit, or make slices smaller.',
  changed: 'A file changed while it was sent: only the node may change the spool.',
  unknown: 'The cause is unknown.',
};

export const remedy = (cause) => (Object.hasOwn(REMEDIES, cause || 'unknown') ? REMEDIES[cause || 'unknown'] : 'The store or the node gave this reason: look in the log of the node.');

const KINDS = { // of one message, and of several
  missed: ['did not reach the node', 'did not reach the node'], dropped: ['was dropped', 'were dropped'], rejected: ['was rejected', 'were rejected'],
  evicted: ['was deleted on the robot', 'were deleted on the robot'], quarantined: ['is in quarantine', 'are in quarantine'],
};

export function GapWords({ gap, swatch, children }) {
  const kind = KINDS[gap.kind]?.[gap.count === 1 ? 0 : 1] ?? gap.kind;
  return html`<div class="chosen" aria-live="polite" data-gap=${gap.cause}><p>${swatch}<b>${gap.topic}</b>: ${gap.grade === 'exact' ? '' : 'about '}${digits(gap.count)} message${gap.count === 1 ? '' : 's'} ${kind}, ${clock(gap.from)} to ${clock(gap.to)} UTC (${span((gap.to - gap.from) / 1000)}).</p>
    <p><b>Why:</b> ${meaning(gap.cause)}${gap.sink === 'objects' ? '' : ` (in ${gap.sink})`}. ${gap.kind === 'quarantined' ? '' : LOOK}</p>
    <p><b>What to do:</b> ${remedy(gap.cause)}</p>${children}</div>`;
}
