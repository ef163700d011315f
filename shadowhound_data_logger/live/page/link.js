// The connection to the robot: frames to items, acknowledgements, the offset of its clock, and coming back after an outage.
//
// A frame is a byte with its lane, a byte of flags (1: an item begins, 2: it ends), two of nothing, and a part of an item. An item is a
// uint32 with the length of its head, the head as JSON padded to eight bytes, and its body.

const SILENT_MS = 3000; // the robot says something each second
const TRY_MS = 1500;
const PINGS = 12;

export class Link {
  constructor({ onItem, onState }) {
    this.onItem = onItem;
    this.onState = onState;
    this.watched = [];
    this.isHidden = document.hidden;
    this.offset = null; // what its clock (ms) is ahead of performance.now()
    this.rtt = null;
    this.bytes = 0;
    this.items = 0;
    document.addEventListener('visibilitychange', () => {
      this.isHidden = document.hidden;
      this.tell();
    });
    setInterval(() => this.tick(), 500);
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

  connect() {
    const socket = new WebSocket(`${location.protocol === 'https:' ? 'wss' : 'ws'}://${location.host}/ws`);
    const parts = new Map();
    let received = 0;
    socket.binaryType = 'arraybuffer';
    this.socket = socket;
    this.triedAt = this.heardAt = performance.now();
    this.pings = [];
    socket.onopen = () => {
      this.onState('connected');
      this.tell();
      this.ping();
    };
    socket.onmessage = ({ data }) => {
      if (socket !== this.socket) return;
      this.heardAt = performance.now();
      received = (received + data.byteLength) >>> 0;
      this.bytes += data.byteLength;
      const acknowledged = new DataView(new ArrayBuffer(4));
      acknowledged.setUint32(0, received, true);
      socket.send(acknowledged.buffer); // on receipt, not when it is drawn
      const [lane, flags] = new Uint8Array(data, 0, 2);
      if (flags === 3) return this.take(new Uint8Array(data, 4));
      if (flags & 1) parts.set(lane, []);
      const known = parts.get(lane);
      if (!known) return;
      known.push(new Uint8Array(data, 4));
      if (flags & 2) {
        parts.delete(lane);
        const whole = new Uint8Array(known.reduce((sum, part) => sum + part.length, 0));
        let at = 0;
        for (const part of known) {
          whole.set(part, at);
          at += part.length;
        }
        this.take(whole);
      }
    };
    socket.onclose = () => {
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
    this.say({ ping: performance.now() });
  }

  // The round with the least delay tells best how the two clocks stand to one another.
  pong({ ping, now }) {
    const here = performance.now();
    this.pings = [...this.pings, { rtt: here - ping, offset: now - (here + ping) / 2 }].slice(-PINGS);
    const best = this.pings.reduce((least, each) => (each.rtt < least.rtt ? each : least));
    this.offset = best.offset;
    this.rtt = here - ping;
  }

  tick() {
    const now = performance.now();
    if (!this.socket) {
      if (now - this.triedAt > 700) this.connect();
    } else if (this.socket.readyState === WebSocket.CONNECTING ? now - this.triedAt > TRY_MS : now - this.heardAt > SILENT_MS) {
      const old = this.socket;
      this.socket = null;
      this.onState('lost');
      old.close();
      this.connect();
    } else {
      this.ping();
    }
  }
}
