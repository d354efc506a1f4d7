// Dock survey: labels of three frames confirmed or corrected, a taped distance, and what lumidock survey makes of them.

import { action, el, ended, get, getBlob, number, post } from './api.js';
import { FrameView } from './frame.js';
import { needsToken, saver, table } from './wizards.js';

const MOST_LISTED = 40; // detections; identified ones come first

// Which light each detection of a frame is, as the recording has it until it is corrected here.
class Labels {
  constructor(about, state, corrected) {
    Object.assign(this, { state, corrected, selects: new Map() });
    const listed = [...state.detections].sort((a, b) => Boolean(b.light) - Boolean(a.light)).slice(0, MOST_LISTED);
    this.root = el('details', { class: 'labels' }, el('summary', {}, `labels of ${listed.length} detections`), el('ul', {}, ...listed.map((d) => this.#row(about, d))));
  }

  #row(about, detection) {
    const at = `at ${number(detection.uv[0], 0)}, ${number(detection.uv[1], 0)} px`;
    const select = el('select', { onchange: () => this.#set(detection, select.value) }, el('option', { value: '' }, 'no light'), ...about.lights.map(({ id }) => el('option', {}, id)));
    select.value = detection.light ?? '';
    this.selects.set(detection, select);
    return el('li', {}, el('label', {}, at, select));
  }

  #set(detection, light) {
    for (const [other, select] of this.selects) {
      if (light && other !== detection && other.light === light) {
        Object.assign(other, { light: '', why: `You gave ${light} to another detection.` }); // a light is seen once
        select.value = '';
      }
    }
    Object.assign(detection, { light, why: 'You said that this is no light.' });
    this.corrected();
  }

  focus(detection) {
    this.root.open = true;
    this.selects.get(detection)?.focus();
  }
}

export class SurveyWizard {
  constructor(about, panel, replay) {
    Object.assign(this, { about, panel, replay });
    const option = (light) => el('option', {}, light.id);
    this.a = el('select', { 'aria-label': 'first light' }, ...about.lights.map(option));
    this.b = el('select', { 'aria-label': 'second light' }, ...about.lights.map(option));
    this.b.selectedIndex = about.lights.length - 1;
    this.tape = el('input', { type: 'text', inputmode: 'decimal', size: 8, placeholder: '5.482', 'aria-label': 'taped metres' });
    this.off = el('input', { type: 'text', inputmode: 'decimal', size: 6, value: '0.05', 'aria-label': 'sigma of the drawing in metres' });
    this.frames = el('div', { class: 'two-columns' });
    this.line = el('output', { class: 'quiet' });
    this.out = el('div');
    this.confirmed = new Map(); // index of a frame: its detections, as confirmed
    panel.append(el('div', { class: 'card' }, el('h2', {}, 'Dock survey'),
      el('p', {}, 'The true positions of the lights from this recording, as lumidock survey finds them. 1. Look at three frames: where a light carries a wrong id or none, click it and choose its id; then confirm the frame. 2. Tape one distance between two lights far apart. 3. Solve, and look at the residuals.'),
      needsToken(), el('div', { class: 'row' }, action('Show three frames', this.line, () => this.#show())), this.frames,
      el('div', { class: 'row' }, el('label', {}, 'from', this.a), el('label', {}, 'to', this.b), el('label', {}, 'taped, m', this.tape), el('label', {}, 'drawing is off by, m (1 sigma)', this.off)),
      el('div', { class: 'row' }, action('Solve', this.line, (tell) => this.#solve(tell), { 'data-writes': '' })), this.line, this.out));
  }

  // The frames with the most lights in the first, middle and last third of the recording.
  async #show() {
    const { count, variants } = await get('/api/recording');
    if (!count) throw new Error('the recording has not been read yet');
    const trust = variants[0].trust, chosen = [];
    for (let third = 0; third < 3; third += 1) {
      const range = [...Array(count).keys()].slice(Math.floor(third * count / 3), Math.floor((third + 1) * count / 3));
      const good = range.filter((k) => trust[k] === 'v');
      chosen.push(...(good.length ? good : range).slice(Math.floor((good.length || range.length) / 2)).slice(0, 1));
    }
    this.confirmed.clear();
    this.wanted = chosen.length;
    this.frames.replaceChildren(...await Promise.all(chosen.map((k) => this.#frame(k))));
    return `confirm ${chosen.length} frames`;
  }

  async #frame(index) {
    const view = new FrameView(this.about);
    view.setZoom(true);
    const [state, jpeg] = await Promise.all([get(`/api/recording/0/${index}`), getBlob(`/api/picture/${index}`)]);
    const right = el('input', { type: 'checkbox', onchange: () => (right.checked ? this.confirmed.set(index, state) : this.confirmed.delete(index)) });
    const corrected = () => {
      right.checked = false; // what was confirmed has changed
      this.confirmed.delete(index);
      view.update(state, jpeg);
    };
    const labels = new Labels(this.about, state, corrected);
    view.picked = (detection) => labels.focus(detection);
    const card = el('div', { class: 'card' }, el('h3', {}, `Frame ${index + 1}`), view.picture, view.hint, labels.root, el('label', {}, right, 'every light carries its own id'));
    requestAnimationFrame(() => view.update(state, jpeg));
    return card;
  }

  async #solve(tell) {
    if (!this.wanted || this.confirmed.size < this.wanted) throw new Error('confirm the frames first');
    const labels = [...this.confirmed.values()].flatMap((state) => state.detections.filter((d) => d.light).map((d) => ({ frame: state.frame, uv: d.uv, light: d.light })));
    const asked = { off_m: Number(this.off.value.replace(',', '.')), labels };
    if (!(asked.off_m > 0)) throw new Error('the sigma of the drawing: wanted metres');
    if (this.tape.value.trim()) {
      Object.assign(asked, { tape_a: this.a.value, tape_b: this.b.value, tape_m: Number(this.tape.value.replace(',', '.')) });
      if (!(asked.tape_m > 0)) throw new Error('the taped distance: wanted metres');
    }
    const found = await ended(await post('/api/survey', asked), (state) => tell(`${state} …`));
    const rms = (v) => Math.hypot(...v);
    this.out.replaceChildren(
      el('p', {}, `${found.frames} frames. Residual in frames held out: ${found.held_out_px.drawing.toFixed(2)} px with the drawing, ${found.held_out_px.survey.toFixed(2)} px with the survey.`),
      ...found.unobserved.map((text) => el('p', { class: 'quiet' }, `Not observed: ${text}`)),
      table(['light', 'moved by, mm', '1 sigma, mm', 'frames', ''], found.lights.map((light) => {
        const bar = el('span', { class: 'residual' });
        bar.style.width = `${Math.min(120, 2000 * rms(light.moved_m))}px`;
        return [light.id, light.moved_m.map((x) => (1000 * x).toFixed(0)).join(', '), (1000 * rms(light.sigma_m)).toFixed(1), light.frames, bar];
      })), saver('survey', '/home/me/dock.yaml'));
    return 'solved; nothing is written until you save it';
  }
}
