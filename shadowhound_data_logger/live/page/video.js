// The camera as video over WebRTC: by choice, or when the robot says that the link is narrow. Frames are drawn as the JPEGs are, and
// each has its age: the timestamps of RTP are the times at which messages came, in ticks of 90 kHz from a random start.
import { html, signal } from './vendor/preact.js';

const NOTHING_MS = 8000; // without a frame, and JPEGs are taken again
const TICKS = 90;
const REPORT_MS = 500;
const PAIRED = 4; // frames that must match

const NO_TIMES = 'this browser does not report the times of frames';
const NOTHING = { bytesReceived: 0, packetsReceived: 0, packetsLost: 0, pliCount: 0 };

export class Video {
  // onFrame is given the <video> element and when its frame came to the robot (ms, by the robot's clock).
  constructor({ link, onFrame, onChange }) {
    Object.assign(this, { link, onFrame, onChange, choice: signal('auto'), state: signal('off'), problem: signal(''), topic: null, wanted: null, frames: 0 });
    document.addEventListener('visibilitychange', () => this.follow());
  }

  // The topic that is sent as video, of which no JPEGs are needed.
  get shown() {
    return this.state.value === 'on' ? this.topic : null;
  }

  choose(choice) {
    this.choice.value = choice;
    this.problem.value = '';
    this.narrow = false;
    this.follow();
  }

  // The camera's topic now; null while nothing live is shown.
  want(topic) {
    if (topic === this.wanted) return;
    this.wanted = topic;
    this.follow();
  }

  // The connection to the robot was lost, and the video with it.
  lost() {
    if (this.pc) this.stop();
  }

  follow() {
    const takes = this.choice.value === 'video' || (this.choice.value === 'auto' && this.narrow);
    const topic = takes && !this.problem.value && !document.hidden ? this.wanted : null;
    if (topic === this.topic) return;
    if (this.pc) this.stop(true);
    if (topic) this.start(topic);
  }

  async start(topic) {
    this.topic = topic;
    this.state.value = 'starting';
    const pc = (this.pc = new RTCPeerConnection({ iceServers: [] }));
    try {
      const { receiver } = pc.addTransceiver('video', { direction: 'recvonly' });
      if ('jitterBufferTarget' in receiver) receiver.jitterBufferTarget = 0;
      const element = document.createElement('video');
      if (!element.requestVideoFrameCallback) throw new Error(NO_TIMES);
      element.muted = element.playsInline = true;
      pc.ontrack = ({ track }) => {
        element.srcObject = new MediaStream([track]);
        element.play().catch(() => {});
      };
      pc.onconnectionstatechange = () => pc === this.pc && ['failed', 'closed'].includes(pc.connectionState) && this.fail('the connection (UDP) was lost');
      element.requestVideoFrameCallback((now, frame) => this.frame(pc, element, frame));
      this.sent = new Map(); // times of the first frames (ms), by tick modulo 2^32
      this.unpaired = []; // RTP timestamps, until they are paired with the times
      this.delays = [];
      this.timer = setTimeout(() => pc === this.pc && this.state.value !== 'on' && this.fail(`${this.unpaired.length ? 'the age of frames was not known' : 'no frame came'} within ${NOTHING_MS / 1000} s`), NOTHING_MS);
      await pc.setLocalDescription(await pc.createOffer());
      await gathered(pc);
      if (pc === this.pc) this.link.say({ video: { topic, offer: pc.localDescription.sdp } });
    } catch (error) {
      if (pc === this.pc) this.fail(error.message);
    }
  }

  frame(pc, element, { rtpTimestamp }) {
    if (pc !== this.pc) return;
    element.requestVideoFrameCallback((now, frame) => this.frame(pc, element, frame));
    if (rtpTimestamp === undefined) return this.fail(NO_TIMES);
    this.clock ??= this.paired(rtpTimestamp);
    if (!this.clock) return;
    const at = this.clock.at + ((rtpTimestamp - this.clock.rtp) | 0) / TICKS; // RTP's ticks are modulo 2^32
    this.clock = { rtp: rtpTimestamp, at };
    this.delays.push(performance.now() - at);
    this.frames += 1;
    if (this.state.value !== 'on') {
      this.state.value = 'on';
      this.onChange();
    }
    this.onFrame(element, at);
  }

  // An RTP timestamp and its time, once several timestamps match the times that the robot sent.
  paired(rtpTimestamp) {
    const rtp = this.unpaired[0];
    this.unpaired.push(rtpTimestamp);
    for (const [tick, at] of this.sent)
      if (this.unpaired.filter((each) => this.sent.has((each - rtp + tick) | 0)).length >= PAIRED) return { rtp, at };
    return null;
  }

  // What came since the last report: the robot sets the bitrate from it, and sends a frame that can be decoded alone when needed.
  async report(pc, before = NOTHING) {
    const stats = await pc.getReceivers()[0].getStats();
    if (pc !== this.pc) return;
    const now = [...stats.values()].find(({ type }) => type === 'inbound-rtp') ?? before;
    const lost = now.packetsLost - before.packetsLost;
    this.link.say({
      video: {
        report: {
          bitrate: ((now.bytesReceived - before.bytesReceived) * 8000) / REPORT_MS,
          lost: Math.max(0, lost) / Math.max(1, lost + now.packetsReceived - before.packetsReceived),
          delay: this.delays.sort((a, b) => a - b)[this.delays.length >> 1] ?? null,
          key: now.pliCount > before.pliCount,
        },
      },
    });
    this.delays = [];
    this.reporting = setTimeout(() => this.report(pc, now), REPORT_MS);
  }

  // What the robot says of it.
  async take({ answer, problem, narrow, at }) {
    if (narrow) {
      this.narrow = true;
      this.follow();
    } else if (problem) this.fail(problem);
    else if (at !== undefined) this.sent?.set(Math.round(at * TICKS) | 0, at);
    else if (answer && this.pc) {
      const { pc } = this;
      try {
        await pc.setRemoteDescription({ type: 'answer', sdp: answer });
        await this.report(pc);
      } catch (error) {
        if (pc === this.pc) this.fail(error.message);
      }
    }
  }

  fail(why) {
    this.problem.value = why;
    this.stop(true);
  }

  stop(tells = false) {
    clearTimeout(this.timer);
    clearTimeout(this.reporting);
    this.pc?.close();
    this.pc = this.clock = this.sent = this.topic = null;
    this.state.value = 'off';
    if (tells) this.link.say({ video: null });
    this.onChange();
  }
}

// No server is asked for addresses, so this takes milliseconds.
function gathered(pc) {
  return new Promise((done) => {
    const look = () => pc.iceGatheringState === 'complete' && done();
    pc.addEventListener('icegatheringstatechange', look);
    setTimeout(done, 1000);
    look();
  });
}

const CHOICES = [['auto', 'Auto'], ['jpeg', 'JPEG'], ['video', 'Video']];
export function VideoChoice({ video, lacks }) {
  if (lacks) return html`<span class="none" title=${lacks} data-video="none">JPEG</span>`;
  const why = video.problem.value ? `No video: ${video.problem.value}. JPEGs are shown.` : 'How the camera is sent; Auto takes video when the link is narrow';
  return html`${video.problem.value && html`<small class="watch" role="status" title=${why}>no video</small>`}<select aria-label="How the camera is sent" title=${why} data-video=${video.state.value} data-problem=${video.problem.value} value=${video.choice.value} onChange=${(event) => video.choose(event.target.value)}>
    ${CHOICES.map(([name, label]) => html`<option value=${name}>${label}</option>`)}</select>`;
}
