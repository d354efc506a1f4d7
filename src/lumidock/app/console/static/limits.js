// Alert limits of the station in use, changed for a trial, and saved in a copy of the station file where the user says.

import { action, el, post } from './api.js';

const BAND = [['below_z_m', 'below z, m'], ['lateral_m', 'lateral, m'], ['axial_m', 'axial, m'], ['angle_deg', 'rotation, deg']];
const GUIDE = [['bearing_deg', 'bearing, deg'], ['range_share', 'range, share of it'], ['range_m', 'range at least, m'], ['from_m', 'from this range on, m']];

export class Limits {
  constructor(about) {
    this.inputs = [];
    const bands = about.limits.filter((entry) => !entry.guide);
    const { guide } = about.limits.find((entry) => entry.guide);
    const cell = (entry, key, name) => el('td', {}, this.#input(entry, key, name));
    const row = (cells) => el('tr', {}, ...cells);
    const grid = (columns, rows) => el('div', { class: 'scroll' }, el('table', {},
      el('thead', {}, el('tr', {}, ...columns.map(([, title]) => el('th', { scope: 'col' }, title)))), el('tbody', {}, ...rows)));
    this.entries = [...bands, { guide }];
    const line = el('output', { class: 'quiet' });
    const path = el('input', { type: 'text', placeholder: '/home/me/dock.yaml', 'aria-label': 'station file', size: 30 });
    const replace = el('input', { type: 'checkbox' });
    this.root = el('div', { class: 'card limits' }, el('h2', {}, 'Alert limits'),
      el('p', {}, 'How large the error of a pose or a guide may be before using it would be dangerous. Larger limits make valid poses begin farther away, and allow larger errors. They belong to the dock: save them in a copy of its station file.'),
      grid(BAND, bands.map((band, k) => row(BAND.map(([key, title]) => cell(band, key, `band ${k + 1}: ${title}`))))),
      el('p', { class: 'quiet' }, 'Beyond the last band the limits are 10 % of z and 10 degrees, none tighter than in the last band.'),
      el('h3', {}, 'Guide'), grid(GUIDE, [row(GUIDE.map(([key, title]) => cell(guide, key, `guide: ${title}`)))]),
      el('div', { class: 'row' }, el('label', {}, 'Station file', path),
        action('Save the station there', line, async () => `saved: ${(await post('/api/limits/save', { path: path.value, limits: this.values(), replace: replace.checked })).saved}`, { 'data-writes': '' }),
        el('label', {}, replace, 'replace a file that exists')), line);
  }

  #input(entry, key, name) {
    const input = el('input', { type: 'text', inputmode: 'decimal', size: 6, value: String(entry[key]), 'aria-label': name, autocomplete: 'off' });
    this.inputs.push({ input, entry, key, name });
    return input;
  }

  // The entries as they stand in the fields. A text that is no number is named instead of guessed.
  values() {
    const found = structuredClone(this.entries);
    for (const { input, entry, key, name } of this.inputs) {
      const text = input.value.trim().replace(',', '.');
      if (text === '' || !Number.isFinite(Number(text))) throw new Error(`${name}: wanted a number`);
      const at = this.entries.findIndex((one) => one === entry || one.guide === entry);
      (found[at].guide ?? found[at])[key] = Number(text);
    }
    return found;
  }

  // The same, or null where they are those in use.
  changed() {
    const values = this.values();
    return JSON.stringify(values) === JSON.stringify(this.entries) ? null : values;
  }

  reset() {
    for (const { input, entry, key } of this.inputs) input.value = String(entry[key]);
  }
}
