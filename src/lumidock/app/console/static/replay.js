// A recording: scrub, step, jump to the next loss or alarm, compare variants, bookmark, and pack a bundle.

import { action, el, ended, get, getBlob, mayWrite, post, saveAs } from './api.js';
import { FrameView } from './frame.js';
import { Timeline } from './timeline.js';

const POLL_MS = 700;

export class Replay {
  constructor(about, places) {
    this.about = about;
    this.places = places;
    this.index = 0;
    this.bookmarks = [];
    this.stretch = null;
    this.views = [new FrameView(about, 'A')];
    this.shown = [0, null]; // variants of A and B
    this.data = { count: 0, pictures: 0, variants: [], t_s: [], frames: [], positions: [], ended: false };
    this.strips = [this.#strip('A'), this.#strip('B')];
    places.replay.append(this.#controls());
    places.frames.append(this.views[0].root);
    places.replay.hidden = false;
    this.#poll();
  }

  #strip(name) {
    return new Timeline({ label: `trust in each frame of ${name}; click to go there`, pick: (index) => this.go(index) });
  }

  #controls() {
    const button = (text, title, run) => el('button', { type: 'button', title, 'aria-label': /[a-z]/.test(text) ? null : title, onclick: run }, text);
    this.slider = el('input', { type: 'range', min: 0, max: 0, value: 0, 'aria-label': 'frame', oninput: () => this.go(Number(this.slider.value)) });
    this.place = el('output');
    this.playing = button('▶ play', 'play or stop (space)', () => this.play());
    this.mark = button('☆ bookmark', 'bookmark this frame (b)', () => this.bookmark());
    this.choices = [0, 1].map((k) => el('select', { onchange: () => this.#choose(k) }));
    this.said = el('p', { class: 'quiet' });
    this.marks = el('div', { class: 'row' });
    this.secondStrip = el('div', { hidden: true }, this.strips[1].root);
    return el('div', { class: 'card' },
      this.strips[0].root, this.secondStrip, this.slider,
      el('div', { class: 'row' },
        button('« loss', 'last loss or alarm (p)', () => this.jump(-1)), button('◀', 'one frame back (left)', () => this.step(-1)),
        this.playing, button('▶', 'one frame on (right)', () => this.step(1)),
        button('loss »', 'next loss or alarm (n)', () => this.jump(1)), this.mark, this.place),
      this.marks, this.said,
      el('div', { class: 'row' },
        el('label', {}, 'A', this.choices[0]), el('label', {}, 'beside B', this.choices[1]),
        button('start [', 'stretch from here (i)', () => this.cut(0)), button('] end', 'stretch to here (o)', () => this.cut(1)),
        this.cutSaid = el('output', { class: 'quiet' }, 'stretch: all frames')),
      this.#more());
  }

  #more() {
    const told = el('p', { class: 'quiet' });
    const method = el('select', { 'aria-label': 'method' }, ...this.about.methods.map((name) => el('option', {}, name)));
    const notes = el('textarea', { rows: 2, 'aria-label': 'notes', placeholder: 'What happened, and what you expected' });
    return el('details', {}, el('summary', {}, 'Compare with another method; pack a bundle for a report'),
      el('div', { class: 'two-columns' },
        el('div', {}, el('h3', {}, 'Another method'), el('p', { class: 'quiet' }, 'Runs the stretch, or all frames, and shows it as B. Other settings are under Settings.'),
          el('div', { class: 'row' }, method, action('Run', told, (tell) => this.rerun(method.value, { settings: {} }, method.value, tell), { 'data-writes': '' }))),
        el('div', {}, el('h3', {}, 'Bundle'), el('p', { class: 'quiet' }, 'Frames of the stretch, their run, settings and bookmarks as a zip file.'),
          notes, el('div', { class: 'row' }, action('Download', told, (tell) => this.#bundle(notes.value, tell), { 'data-writes': '' })))),
      mayWrite ? null : el('p', { class: 'quiet' }, 'Both need the address with #token= that the command printed.'), told);
  }

  async #poll() {
    try {
      this.data = await get('/api/recording');
      this.#refresh();
    } catch (error) {
      this.said.textContent = `The console does not answer: ${error.message}`;
    }
    if (!this.data.ended) setTimeout(() => this.#poll(), POLL_MS);
  }

  #refresh() {
    const { count, pictures, total, problem, variants, ended: done } = this.data;
    this.slider.max = Math.max(0, count - 1);
    this.said.textContent = problem || (done ? '' : `reading: ${Math.max(count && pictures, pictures)} of ${total ?? '?'} frames`);
    this.said.classList.toggle('bad', Boolean(problem));
    for (const [k, choice] of this.choices.entries()) {
      choice.replaceChildren(...(k ? [el('option', { value: '' }, 'nothing')] : []),
        ...variants.map((v) => el('option', { value: v.number }, v.label)));
      choice.value = this.shown[k] ?? '';
    }
    this.#drawStrips();
    if (this.drawn !== this.index || this.waiting) this.go(this.index);
  }

  #variant(k) {
    return this.data.variants.find((v) => v.number === this.shown[k]);
  }

  #drawStrips() {
    for (const [k, strip] of this.strips.entries()) {
      const variant = this.#variant(k);
      if (variant) {
        strip.set({ trust: variant.trust, first: variant.first, count: Math.max(1, this.data.count), events: variant.events,
          cursor: this.index, bookmarks: this.bookmarks, stretch: this.stretch });
      }
    }
  }

  async go(index) {
    this.index = Math.max(0, Math.min(this.data.count - 1, index));
    if (this.busy || this.data.count === 0) { this.again = true; return; } // only the newest wish counts
    this.busy = true;
    try {
      do {
        this.again = false;
        await this.#show(this.index);
      } while (this.again);
    } catch (error) {
      this.said.textContent = error.message;
    } finally {
      this.busy = false;
    }
  }

  async #show(index) {
    const numbers = this.shown.slice(0, this.views.length);
    const [jpeg, ...states] = await Promise.all([getBlob(`/api/picture/${index}`), ...numbers.map((n) => get(`/api/recording/${n}/${index}`))]);
    this.waiting = !jpeg && !this.data.ended;
    for (const [k, view] of this.views.entries()) {
      if (states[k]) {
        view.title.textContent = `${'AB'[k]}: ${this.#variant(k).label}`;
        view.plans.setTrail(k ? [] : this.data.positions.slice(0, index + 1).filter(Boolean), this.data.positions.filter(Boolean));
        await view.update(states[k], jpeg);
      }
    }
    this.drawn = index;
    this.slider.value = index;
    this.slider.setAttribute('aria-valuetext', `frame ${this.data.frames[index]}`);
    this.place.textContent = `${index + 1} of ${this.data.count}, ${(this.data.t_s[index] ?? 0).toFixed(2)} s`;
    this.mark.textContent = this.bookmarks.includes(index) ? '★ bookmarked' : '☆ bookmark';
    this.#drawStrips();
  }

  step(by) {
    this.go(this.index + by);
  }

  async play() {
    this.running = !this.running;
    this.playing.textContent = this.running ? '■ stop' : '▶ play';
    while (this.running && this.index < this.data.count - 1) {
      const [from, to] = [this.data.t_s[this.index] ?? 0, this.data.t_s[this.index + 1] ?? 0];
      const start = performance.now();
      await this.go(this.index + 1);
      const pause = Math.min(500, Math.max(20, (to - from) * 1000)) - (performance.now() - start);
      await new Promise((done) => setTimeout(done, Math.max(0, pause)));
    }
    this.running = false;
    this.playing.textContent = '▶ play';
  }

  // The next loss or alarm of A, or of B beside it.
  jump(direction) {
    const events = [0, 1].flatMap((k) => this.#variant(k)?.events ?? []).sort((a, b) => a.index - b.index);
    const found = direction > 0 ? events.find((e) => e.index > this.index) : events.findLast((e) => e.index < this.index);
    this.said.textContent = found ? `${found.kind}: ${found.reason || 'no reason'} in frame ${this.data.frames[found.index]}` : `no ${direction > 0 ? 'later' : 'earlier'} loss or alarm`;
    if (found) this.go(found.index);
  }

  bookmark() {
    this.bookmarks = this.bookmarks.includes(this.index) ? this.bookmarks.filter((k) => k !== this.index) : [...this.bookmarks, this.index].sort((a, b) => a - b);
    this.marks.replaceChildren(...this.bookmarks.map((k) => el('button', { type: 'button', onclick: () => this.go(k) }, `★ ${this.data.frames[k]}`)));
    this.go(this.index);
  }

  cut(end) {
    const now = this.stretch ?? [0, Math.max(0, this.data.count - 1)];
    now[end] = this.index;
    this.stretch = now[0] <= now[1] ? now : [this.index, this.index];
    this.cutSaid.textContent = `stretch: frames ${this.stretch[0] + 1} to ${this.stretch[1] + 1}`;
    this.#drawStrips();
  }

  #choose(k) {
    const value = this.choices[k].value;
    this.shown[k] = value === '' ? null : Number(value);
    this.#setSecond(this.shown[1] !== null);
    this.go(this.index);
  }

  #setSecond(wanted) {
    this.secondStrip.hidden = !wanted;
    this.places.frames.classList.toggle('two', wanted);
    if (wanted && this.views.length === 1) {
      this.views.push(new FrameView(this.about, 'B'));
      this.views[1].setZoom(this.views[0].zoomed);
      this.places.frames.append(this.views[1].root);
    } else if (!wanted && this.views.length === 2) {
      this.views.pop().root.remove();
    }
  }

  // Run with another method or settings, and show it as B.
  async rerun(method, choice, label, tell) {
    const stretch = this.stretch ? { first: this.stretch[0], last: this.stretch[1] } : {};
    const job = await post('/api/rerun', { method, ...choice, label, ...stretch });
    const { variant } = await ended(job, (state) => tell(`${state} …`));
    this.data = await get('/api/recording');
    this.shown[1] = variant;
    this.#setSecond(true);
    this.#refresh();
    const at = this.stretch ? Math.max(this.stretch[0], Math.min(this.stretch[1], this.index)) : this.index;
    await this.go(at);
    const counts = [0, 1].map((k) => [...this.#variant(k).trust].filter((t) => t === 'v').length);
    return `B: ${counts[1]} valid of ${this.#variant(1).trust.length}; A: ${counts[0]} valid of ${this.#variant(0).trust.length}`;
  }

  async #bundle(notes, tell) {
    const [first, last] = this.stretch ?? [0, this.data.count - 1];
    const job = await post('/api/bundle', { variant: this.shown[1] ?? 0, first, last, bookmarks: this.bookmarks, notes });
    await ended(job, (state) => tell(`packing: ${state} …`));
    saveAs(await getBlob(`/api/jobs/${job.number}/file`), 'lumidock-bundle.zip');
    return 'the bundle was downloaded';
  }

  key(event) {
    const run = {
      ArrowLeft: () => this.step(event.shiftKey ? -10 : -1), ArrowRight: () => this.step(event.shiftKey ? 10 : 1),
      ' ': () => this.play(), n: () => this.jump(1), p: () => this.jump(-1), b: () => this.bookmark(),
      i: () => this.cut(0), o: () => this.cut(1), Home: () => this.go(0), End: () => this.go(this.data.count - 1),
    }[event.key];
    if (run) { event.preventDefault(); run(); }
  }
}
