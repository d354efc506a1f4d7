// Settings with their meaning, tried before they are used, and profiles: files where the user says.

import { action, el, ended, get, mayWrite, post, saveAs } from './api.js';
import { Limits } from './limits.js';
import { Timeline } from './timeline.js';

const KEEP_MS = 2000;

export class Settings {
  constructor(about, panel, replay) {
    Object.assign(this, { about, panel, replay, inputs: new Map() });
    this.cards = el('div', { class: 'settings' });
    this.text = el('pre', { tabindex: '0', 'aria-label': 'the profile' });
    this.result = el('div');
    this.keptSaid = el('p', { class: 'quiet' });
    this.kept = 0;
    this.limits = new Limits(about);
    panel.append(
      el('p', {}, replay
        ? 'Change a setting and run a stretch of the recording with it, beside what was recorded. Nothing is written unless you save a profile.'
        : 'Change a setting and try it on the last seconds of the camera. Guidance keeps its own settings: save a profile, and start lumidock serve with --config and this file.'),
      this.cards, el('div', { class: 'two-columns' }, this.#trial(), this.#profile()),
      this.limits.root);
    this.#load();
  }

  async #load() {
    this.settings = await get('/api/settings');
    this.cards.replaceChildren(...this.settings.map((one) => this.#card(one)));
    this.#changed();
  }

  #card(one) {
    const id = `set-${one.path.replaceAll('.', '-')}`;
    const input = el('input', { id, type: 'text', inputmode: 'decimal', value: String(one.value), autocomplete: 'off' });
    const card = el('div', { class: 'card setting' }, el('label', { for: id }, one.title),
      el('div', { class: 'row' }, input, el('span', { class: 'quiet' }, `${one.unit ? `${one.unit}, ` : ''}default ${one.default}`)),
      el('p', {}, one.effect), el('details', {}, el('summary', {}, one.path), one.source || 'no comment in the source'));
    input.addEventListener('input', () => this.#changed());
    this.inputs.set(one.path, { input, card, one });
    return card;
  }

  // The settings that differ from those in use. A text that is no number is named instead of guessed.
  values() {
    const found = {};
    for (const [path, { input, one }] of this.inputs) {
      const text = input.value.trim().replace(',', '.');
      if (text === '' || !Number.isFinite(Number(text))) throw new Error(`${one.title}: wanted a number`);
      if (Number(text) !== one.value) found[path] = Number(text);
    }
    return found;
  }

  async #changed() {
    for (const { input, card, one } of this.inputs.values()) card.classList.toggle('changed', Number(input.value) !== one.value);
    if (!mayWrite) { this.text.textContent = 'Saving needs the address with #token= that the command printed.'; return; }
    try {
      this.text.textContent = (await post('/api/profile/text', { settings: this.values(), vehicle: this.vehicle.value })).text;
      this.text.classList.remove('bad');
    } catch (error) {
      this.text.textContent = error.message;
      this.text.classList.add('bad');
    }
  }

  #trial() {
    const line = el('output', { class: 'quiet' });
    const label = this.replay ? 'Run the stretch' : 'Preview on the last seconds';
    const reset = el('button', { type: 'button', onclick: () => { for (const { input, one } of this.inputs.values()) input.value = String(one.value); this.limits.reset(); this.#changed(); } }, 'Reset');
    return el('div', { class: 'card' }, el('h2', {}, 'Try'),
      el('div', { class: 'row' }, action(label, line, (tell) => (this.replay ? this.#rerun(tell) : this.#preview(tell)), { 'data-writes': '' }), reset),
      this.keptSaid, line, this.result);
  }

  async #rerun(tell) {
    const settings = this.values(), limits = this.limits.changed();
    const names = Object.entries(settings).map(([path, value]) => `${path} ${value}`);
    const label = [...names, ...(limits ? ['other alert limits'] : [])].join(', ') || 'same settings';
    const told = await this.replay.rerun(this.about.method, { settings, limits }, label, tell);
    return `${told}. It is shown as B in Replay.`;
  }

  // Called while this panel is open: the server keeps frames for a preview only so long as someone may want one.
  keep() {
    if (this.replay || !mayWrite || this.panel.hidden) return;
    post('/api/keep').then((kept) => {
      this.kept = kept.frames;
      this.keptSaid.textContent = `${kept.frames} frames are kept, ${kept.seconds} s`;
    }).catch(() => {});
    setTimeout(() => this.keep(), KEEP_MS);
  }

  async #preview(tell) {
    const settings = this.values();
    if (!this.kept) throw new Error('no frame has been kept yet; wait some seconds');
    const job = await post('/api/preview', { settings, limits: this.limits.changed() });
    const found = await ended(job, (state) => tell(`${state} …`));
    const strips = [['in_use', 'In use'], ['proposed', 'Proposed']].map(([key, title]) => {
      const strip = new Timeline({ small: true, label: title }), one = found[key], valid = [...one.trust].filter((t) => t === 'v').length;
      setTimeout(() => strip.set({ trust: one.trust, count: Math.max(1, one.trust.length) }));
      const reasons = Object.entries(one.reasons).map(([word, count]) => `${word} ${count}`).join(', ') || 'none';
      return el('div', {}, el('h3', {}, title), strip.root,
        el('p', { class: 'quiet' }, `${valid} valid of ${one.trust.length} frames; ${one.detections} detections, ${one.used} lights used; reasons: ${reasons}`));
    });
    this.result.replaceChildren(...strips);
    return `the last ${found.seconds} s, without history before them`;
  }

  #profile() {
    const line = el('output', { class: 'quiet' });
    this.vehicle = el('input', { type: 'text', placeholder: 'BlueROV2', 'aria-label': 'vehicle', oninput: () => this.#changed() });
    const path = el('input', { type: 'text', placeholder: '/home/me/dock-bluerov2.yaml', 'aria-label': 'file', size: 30 });
    const replace = el('input', { type: 'checkbox' });
    const save = () => post('/api/profile/save', { path: path.value, settings: this.values(), vehicle: this.vehicle.value, replace: replace.checked });
    return el('div', { class: 'card' }, el('h2', {}, 'Profile for this dock and vehicle'),
      el('p', { class: 'quiet' }, 'What differs from the defaults, as a configuration file for --config.'),
      el('div', { class: 'row' }, el('label', {}, 'Vehicle', this.vehicle), el('label', {}, 'File', path)), this.text,
      el('div', { class: 'row' },
        action('Save there', line, async () => `saved: ${(await save()).saved}`, { 'data-writes': '' }),
        el('label', {}, replace, 'replace a file that exists'),
        action('Load', line, async () => this.#use(await post('/api/profile/load', { path: path.value }), path.value), { 'data-writes': '' }),
        action('Download', line, async () => { saveAs(new Blob([this.text.textContent], { type: 'text/yaml' }), 'lumidock-profile.yaml'); return 'downloaded'; }, { 'data-writes': '' })),
      line);
  }

  #use(loaded, path) {
    for (const one of loaded) this.inputs.get(one.path).input.value = String(one.value);
    this.#changed();
    return `loaded ${path}; nothing is changed until you use it`;
  }
}
