// What the live view begins with: plots, path and plan of the time before the page was opened.
import { recent } from './past.js';

const LATER_MS = 600; // what is seen now goes first

// `rings` by kind; `chosen(kind)`: the topic that is shown; `plan()`: the floor plan, once it is there.
export function prefill({ rings, chosen, plan, onPath }) {
  setTimeout(async () => {
    let items = [];
    try {
      items = await recent();
    } catch { /* there is no spool, or nothing in it: the view begins empty */ }
    for (const [item, body] of items) {
      const { kind, topic } = item;
      if (kind === 'path') {
        const view = new DataView(body.buffer);
        const poses = Array.from({ length: item.points }, (_, row) => [0, 1, 2].map((place) => view.getFloat32((row * 3 + place) * 4, true)));
        const floor = plan();
        if (floor) {
          const walked = floor.path;
          floor.trail(poses);
          floor.path.push(...walked);
          onPath(floor.path);
        }
      } else if (kind === 'cloud') plan()?.cloud(item, body, true);
      else if (rings[kind] && (chosen(kind) ?? topic) === topic) rings[kind].before(item, body);
    }
    (window.shadowhound ??= {}).prefilled = items.length;
  }, LATER_MS);
}
