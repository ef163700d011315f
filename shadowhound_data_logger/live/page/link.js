// The connection to the robot: frames to items, acknowledgements, the offset of its clock, and coming back after an outage.
//
// A frame has parts of items. Each is a byte with its lane, a byte of flags (1: an item begins, 2: it ends), two unused bytes, a uint32
// with its length, and that many bytes. An item is a uint32 with the length of its head, the head as JSON padded to eight bytes, and
// its body.

const SILENT_MS = 3000; // the robot says something each second
const ACKNOWLEDGED = 2048; // bytes, at least, between two acknowledgements
const TICK_MS = 250;
const PING_MS = 500;
const PINGS = 12;
// How long an attempt to connect gets. A lost packet of it is sent again after 1 s, then after 2 and 4: a new attempt is sooner. One in
// four has longer, for a link so slow that the others end too early.
const TRY_MS = [1000, 1000, 1000, 2500];
const MOST_TRY_MS = 5000;
const ROUNDS = 6; // of the link, that an attempt takes at most
const JITTER_MS = 250;

export class Link {
  constructor({ onItem, onState }) {
    this.onItem = onItem;
    this.onState = onState;
    this.watched = [];
    this.isHidden = document.hidden;
    this.offset = null; // what its clock (ms) is ahead of performance.now()
    this.rtt = null; // the least of late, ms
    this.tries = 0; // since it was connected
    this.isStopped = false;
    this.bytes = 0;
    this.items = 0;
    document.addEventListener('visibilitychange', () => {
      this.isHidden = document.hidden;
      this.tell();
      this.tick();
    });
    addEventListener('online', () => !this.isStopped && this.socket?.readyState !== WebSocket.OPEN && this.connect());
    setInterval(() => this.tick(), TICK_MS);
    this.connect();
  }

  // The robot's time now, ms; null before the first answer.
  now() {
    return this.offset === null ? null : performance.now() + this.offset;
  }

  watch(topics) {
    if (topics.join() === this.watched.join()) return;
    this.watched = topics;
    this.tell();
  }

  tell() {
    this.say({ watch: this.isHidden ? [] : this.watched });
  }

  say(what) {
    if (this.socket?.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(what));
  }

  // While nobody is signed in, no connection is tried.
  stop() {
    this.isStopped = true;
    const old = this.socket;
    this.socket = null;
    old?.close();
  }

  start() {
    if (!this.isStopped) return;
    this.isStopped = false;
    this.tries = 0;
    this.connect();
  }

  connect() {
    const old = this.socket;
    this.socket = null;
    old?.close(); // before the next one: browsers begin one at a time
    const socket = new WebSocket(`${location.protocol === 'https:' ? 'wss' : 'ws'}://${location.host}/ws`);
    const parts = new Map();
    let received = 0;
    let told = 0;
    let isTelling = false;
    // Frames are acknowledged on receipt, not when they are drawn, and a burst once: the frames of it that have already arrived are
    // handled before this message to ourselves. Unlike a timer, it is not delayed in a hidden tab.
    const telling = new MessageChannel();
    telling.port1.onmessage = () => {
      isTelling = false;
      told = received;
      if (socket.readyState === WebSocket.OPEN) socket.send(Uint32Array.of(received % 2 ** 32));
    };
    socket.binaryType = 'arraybuffer';
    this.socket = socket;
    this.triedAt = this.heardAt = performance.now();
    this.pings = [];
    this.patience = Math.max(TRY_MS[this.tries % TRY_MS.length], Math.min(ROUNDS * (this.rtt ?? 0), MOST_TRY_MS)) + JITTER_MS * Math.random();
    this.tries += 1;
    socket.onopen = () => {
      if (socket !== this.socket) return;
      this.tries = 0;
      this.onState('connected');
      this.tell();
      this.ping();
    };
    socket.onmessage = ({ data }) => {
      if (socket !== this.socket) return;
      this.heardAt = performance.now();
      received += data.byteLength;
      this.bytes += data.byteLength;
      if (received - told >= ACKNOWLEDGED && !isTelling) {
        isTelling = true;
        telling.port2.postMessage(null);
      }
      const view = new DataView(data);
      for (let at = 0; at < data.byteLength; at += 8 + view.getUint32(at + 4, true)) {
        const [lane, flags] = new Uint8Array(data, at, 2);
        if (flags & 1) parts.set(lane, []);
        const known = parts.get(lane);
        if (!known) continue;
        known.push(new Uint8Array(data, at + 8, view.getUint32(at + 4, true)));
        if (flags & 2) {
          parts.delete(lane);
          const whole = new Uint8Array(known.reduce((sum, part) => sum + part.length, 0));
          let end = 0;
          for (const part of known) {
            whole.set(part, end);
            end += part.length;
          }
          this.take(whole);
        }
      }
    };
    socket.onclose = () => {
      telling.port1.close();
      if (socket !== this.socket) return;
      this.socket = null;
      this.onState('lost');
    };
  }

  take(whole) {
    const length = new DataView(whole.buffer, whole.byteOffset, 4).getUint32(0, true);
    const head = JSON.parse(new TextDecoder().decode(whole.subarray(4, 4 + length)));
    this.items += 1;
    if (head.kind === 'pong') return this.pong(head);
    this.onItem(head, whole.subarray(4 + length));
  }

  ping() {
    this.pingedAt = performance.now();
    this.say({ ping: performance.now() });
  }

  // The round with the least delay tells best how the two clocks stand to one another.
  pong({ ping, now }) {
    const here = performance.now();
    this.pings = [...this.pings, { rtt: here - ping, offset: now - (here + ping) / 2 }].slice(-PINGS);
    const best = this.pings.reduce((least, each) => (each.rtt < least.rtt ? each : least));
    this.offset = best.offset;
    this.rtt = best.rtt;
  }

  // A connection that is silent is given up: what TCP sends again after an outage comes later than what a new one brings.
  tick() {
    if (this.isStopped) return;
    const now = performance.now();
    const isOpen = this.socket?.readyState === WebSocket.OPEN;
    if (isOpen && now - this.heardAt <= SILENT_MS) {
      if (now - this.pingedAt >= PING_MS) this.ping();
    } else if (isOpen) {
      this.onState('lost');
      this.connect();
    } else if (now - this.triedAt > this.patience && !this.isHidden) {
      this.connect();
    }
  }
}
