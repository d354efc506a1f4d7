// The live view: asks for the newest frame when it has drawn the last one, so that a slow page only slows itself.

import { el, liveSocket, number } from './api.js';
import { FrameView } from './frame.js';
import { Timeline } from './timeline.js';

const HISTORY = 600; // fixes of the strip and the trail, a minute at ten a second
const HEALTH = ['ok', 'up_s', 'camera', 'fixes', 'sinks'];
const JUMP_M = 2;
const STALE_MS = 1500;
const RETRY_MS = 1000;

export class Live {
  constructor(about, places, problem) {
    this.problem = problem;
    this.view = new FrameView(about);
    this.strip = new Timeline({ label: 'trust over the last minute' });
    this.health = el('div', { class: 'two-columns' });
    places.frames.append(this.view.root);
    places.below.append(
      el('div', { class: 'card' }, el('h2', {}, 'Trust over the last minute'), this.strip.root),
      el('div', { class: 'card' }, el('h2', {}, 'Rates, latencies and drops'), this.health));
    this.trust = '';
    this.trail = [];
    this.seen = 0;
    this.at = performance.now();
    this.#connect();
    setInterval(() => this.#watch(), 500);
    document.addEventListener('visibilitychange', () => this.#ask());
  }

  #connect() {
    this.socket = liveSocket();
    this.owed = false;
    this.socket.addEventListener('open', () => this.#ask());
    this.socket.addEventListener('message', (event) => this.#show(event.data));
    this.socket.addEventListener('close', () => setTimeout(() => this.#connect(), RETRY_MS));
  }

  #ask() {
    if (document.hidden || this.owed || this.socket.readyState !== WebSocket.OPEN) return;
    this.owed = true;
    this.socket.send(String(this.seen));
  }

  async #show(data) {
    const length = new DataView(data).getUint32(0, true);
    const state = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
    const jpeg = data.byteLength > 4 + length ? new Blob([new Uint8Array(data, 4 + length)], { type: 'image/jpeg' }) : null;
    this.seen = state.number;
    this.at = performance.now();
    this.trust = (this.trust + state.trust[0]).slice(-HISTORY);
    if (state.pose) this.#follow(state.pose.position);
    this.view.plans.setTrail(this.trail);
    for (const [name, value] of Object.entries(state.health)) {
      if (!HEALTH.includes(name)) state.more[name] = value; // go / no-go, aiding and what else a server tells
    }
    await this.view.update(state, jpeg);
    this.strip.set({ trust: this.trust, count: Math.max(100, this.trust.length) });
    this.#tellHealth(state.health);
    this.owed = false;
    requestAnimationFrame(() => this.#ask());
  }

  // The trail of one approach: it begins anew where the vehicle cannot have gone meanwhile.
  #follow(position) {
    const last = this.trail.at(-1), jumped = last && Math.hypot(...position.map((x, k) => x - last[k])) > JUMP_M;
    this.trail = jumped ? [position] : [...this.trail, position].slice(-HISTORY);
  }

  // What is on the page may be old: that is said before anyone acts on it.
  #watch() {
    const old = performance.now() - this.at, stale = old > STALE_MS;
    this.view.picture.classList.toggle('stale', stale);
    this.problem.hidden = !stale || document.hidden;
    const why = this.socket.readyState === WebSocket.OPEN ? 'No new frame' : 'No connection to the console';
    this.problem.textContent = `${why} for ${(old / 1000).toFixed(0)} s: what is shown is old.`;
    this.#ask();
  }

  #tellHealth(health) {
    const { camera, fixes, sinks } = health;
    if (!camera) return;
    const pairs = [
      ['camera', `${number(camera.rate_hz, 1, 'Hz')}, ${camera.frames} frames, ${camera.dropped} came too fast and were dropped`],
      ['camera lost', `${camera.reconnects} times${camera.problem ? `; now: ${camera.problem}` : ''}`],
      ['localizing', `median ${number(fixes.latency_ms.p50, 1)}, 99 % ${number(fixes.latency_ms.p99, 1, 'ms')}`],
      ['fixes', `${fixes.valid} valid, ${fixes.guide} with a guide, of ${fixes.frames}`],
      ['reasons', Object.entries(fixes.reasons).map(([word, count]) => `${word} ${count}`).join(', ') || 'none'],
    ];
    const rows = Object.entries(sinks).map(([name, sink]) => el('tr', {}, el('td', {}, name), el('td', {}, sink.sent),
      el('td', {}, sink.dropped + sink.stale), el('td', {}, number(sink.frame_to_sent_ms.p99, 1)), el('td', {}, sink.problem)));
    this.health.replaceChildren(
      el('dl', { class: 'pairs' }, ...pairs.flatMap(([name, value]) => [el('dt', {}, name), el('dd', {}, value)])),
      el('div', { class: 'scroll' }, el('table', {}, el('thead', {}, el('tr', {},
        ...['sink', 'sent', 'dropped', '99 %, ms', 'problem'].map((name) => el('th', { scope: 'col' }, name)))), el('tbody', {}, ...rows))));
  }
}
