// The address under which a Foxglove or Lichtblick gets the topics: asked for when somebody opens this.
import { html, useState } from './vendor/preact.js';

export function Foxglove() {
  const [told, setTold] = useState('');
  const ask = async ({ target }) => {
    if (!target.open) return setTold('');
    const answer = await fetch('/api/foxglove').catch(() => null);
    const content = await answer?.json();
    setTold(answer?.ok ? `${location.protocol === 'https:' ? 'wss' : 'ws'}://${location.host}${content.path}` : content?.error ?? 'no answer');
  };
  return html`<details onToggle=${ask}><summary>Open in Foxglove or Lichtblick</summary>
    <p class="note">Open a connection of the kind “Foxglove WebSocket” to this address. Whoever has it may watch from this computer's address until it ends: with your sign-in, in 12 hours at most, or when you sign in again here.</p>
    <p class="note"><code data-foxglove>${told}</code></p></details>`;
}
