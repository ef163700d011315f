// The camera as video over WebRTC: by choice, or when the robot says that the link is narrow. Frames are drawn as the JPEGs are, and
// each has its age: the timestamps of RTP are the times at which messages came, in ticks of 90 kHz.
import { html, signal } from './vendor/preact.js';

const NOTHING_MS = 8000; // without a frame, and JPEGs are taken again
const TICKS = 90;

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
      if (!element.requestVideoFrameCallback) throw new Error('this browser does not tell the times of frames');
      element.muted = element.playsInline = true;
      pc.ontrack = ({ track }) => {
        element.srcObject = new MediaStream([track]);
        element.play().catch(() => {});
      };
      pc.onconnectionstatechange = () => pc === this.pc && ['failed', 'closed'].includes(pc.connectionState) && this.fail('the connection (UDP) was lost');
      element.requestVideoFrameCallback((now, frame) => this.frame(pc, element, frame));
      this.timer = setTimeout(() => pc === this.pc && this.state.value !== 'on' && this.fail(`no frame came within ${NOTHING_MS / 1000} s`), NOTHING_MS);
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
    if (rtpTimestamp === undefined) return this.fail('this browser does not tell the times of frames');
    if (!this.clock) return;
    const at = this.clock.at + ((rtpTimestamp - this.clock.rtp) | 0) / TICKS; // RTP's ticks are modulo 2^32
    this.clock = { rtp: rtpTimestamp, at };
    this.frames += 1;
    if (this.state.value !== 'on') {
      this.state.value = 'on';
      this.onChange();
    }
    this.onFrame(element, at);
  }

  // What the robot says of it.
  async take({ answer, problem, narrow, rtp, at }) {
    if (narrow) {
      this.narrow = true;
      this.follow();
    } else if (problem) this.fail(problem);
    else if (rtp !== undefined) this.clock = { rtp, at };
    else if (answer && this.pc) {
      const { pc } = this;
      await pc.setRemoteDescription({ type: 'answer', sdp: answer }).catch((error) => pc === this.pc && this.fail(error.message));
    }
  }

  fail(why) {
    this.problem.value = why;
    this.stop(true);
  }

  stop(tells = false) {
    clearTimeout(this.timer);
    this.pc?.close();
    this.pc = this.clock = this.topic = null;
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
