// Dock check and calibration in water, step by step; each ends in the command of the same purpose.

import { action, el, ended, mayWrite, number, post, svg } from './api.js';

const ENOUGH = 20; // corners in a cell, as calib water advises
const LOOK_MS = 800;

export function table(titles, rows) {
  return el('div', { class: 'scroll' }, el('table', {},
    el('thead', {}, el('tr', {}, ...titles.map((title) => el('th', { scope: 'col' }, title)))),
    el('tbody', {}, ...rows.map((row) => el('tr', {}, ...row.map((cell) => el('td', {}, cell)))))));
}

export function needsToken() {
  return mayWrite ? null : el('p', { class: 'bad' }, 'This needs the address with #token= that the command printed.');
}

// Where a result goes: a path, a box to replace what is there, and a button.
export function saver(kind, placeholder) {
  const line = el('output', { class: 'quiet' });
  const path = el('input', { type: 'text', placeholder, 'aria-label': `file of the ${kind}`, size: 30 });
  const replace = el('input', { type: 'checkbox' });
  return el('div', {}, el('div', { class: 'row' }, el('label', {}, 'File', path),
    action('Save there', line, async () => `saved: ${(await post('/api/save', { kind, path: path.value, replace: replace.checked })).saved}`, { 'data-writes': '' }),
    el('label', {}, replace, 'replace a file that exists')), line);
}

export function dockCheck(about, panel) {
  const line = el('output', { class: 'quiet' }), out = el('div');
  async function run(tell) {
    const found = await ended(await post('/api/check'), (state) => tell(`${state}: it takes some seconds …`));
    const failed = found.failed.length ? el('ul', {}, ...found.failed.map((text) => el('li', { class: 'bad' }, `✕ ${text}`))) : el('p', {}, '✓ All checks passed.');
    out.replaceChildren(failed, el('h3', {}, 'Head-on approach: what is in view, and the best levels that the lights allow'),
      table(['z, m', 'stage', 'lights', 'lateral, m', 'axial, m', 'angle, deg', ''], found.corridor.map((row) => [
        row.z_m, row.stage, Object.entries(row.lights).map(([layer, n]) => `${layer} ${n}`).join(', '),
        number(row.lateral_m, 3), number(row.axial_m, 3), number(row.angle_deg, 2), row.valid ? '✓ valid' : row.lateral_m === null ? '✕ no pose' : '✕ over the limits'])),
      el('h3', {}, 'How well a wrong assignment fits, px at 18 m: the more the better'),
      table(['layer', 'lights seen', 'wrong assignment', 'mirror image'], found.confusions.map((row) => [
        row.layer, row.seen, number(row.assignment_px), number(row.mirror_px)])));
    return `${found.name}: ${found.failed.length ? `${found.failed.length} checks failed` : 'all checks passed'}`;
  }
  panel.append(el('div', { class: 'card' }, el('h2', {}, 'Dock check'), el('p', {}, `Checks ${about.station_file} with the camera in use, as lumidock station check does.`),
    needsToken(), el('div', { class: 'row' }, action('Check', line, run, { 'data-writes': '' })), line, out));
}

export class CalibrateWizard {
  constructor(about, panel) {
    Object.assign(this, { about, panel });
    const field = (label, value, size = 6) => {
      const input = el('input', { type: 'text', value, size });
      return [el('label', {}, label, input), input];
    };
    const kind = el('select', {}, el('option', {}, 'charuco'), el('option', {}, 'chessboard'));
    const [columnsLabel, columns] = field('squares across', '8', 3);
    const [rowsLabel, rows] = field('down', '6', 3);
    const [squareLabel, square] = field('side, m', '0.04');
    const [markerLabel, marker] = field('marker, m', '0.03');
    const [dictionaryLabel, dictionary] = field('dictionary', 'DICT_4X4_50', 14);
    this.model = el('select', {}, el('option', {}, 'plumb_bob'), el('option', {}, 'equidistant'));
    this.board = () => ({ kind: kind.value, columns: Number(columns.value), rows: Number(rows.value), square_m: Number(square.value), marker_m: Number(marker.value), dictionary: dictionary.value });
    this.line = el('output', { class: 'quiet' });
    this.out = el('div');
    this.map = el('div', { class: 'coverage', role: 'img', 'aria-label': 'corners in each part of the picture' });
    const live = about.mode === 'live';
    panel.append(el('div', { class: 'card' }, el('h2', {}, 'Calibration in water'),
      el('p', {}, live ? '1. Describe the board. 2. Look for it, and take views until each part of the picture is covered and the board was tilted. 3. Solve, compare, save.'
        : 'Describe the board that the recording shows; views are chosen from all of it, as lumidock calib water does.'),
      needsToken(), el('div', { class: 'row' }, el('label', {}, 'board', kind), columnsLabel, rowsLabel, squareLabel, markerLabel, dictionaryLabel),
      live ? this.#taking() : null,
      el('div', { class: 'row' }, el('label', {}, 'lens', this.model), action('Solve', this.line, (tell) => this.#solve(tell), { 'data-writes': '' })),
      this.line, this.out));
  }

  #taking() {
    this.corners = svg('svg', { viewBox: `0 0 ${this.about.width} ${this.about.height}`, role: 'img', 'aria-label': 'corners of the board in the picture' });
    const picture = el('div', { class: 'picture' }, this.corners);
    picture.style.aspectRatio = `${this.about.width} / ${this.about.height}`;
    picture.style.maxWidth = '360px';
    this.looking = el('input', { type: 'checkbox', disabled: !mayWrite, onchange: () => this.#watch() });
    return el('div', {}, el('div', { class: 'row' }, el('label', {}, this.looking, 'look for the board'),
      action('Take this view', this.line, async () => this.#show(await post('/api/board/look', { ...this.board(), take: true })), { 'data-writes': '' }),
      action('Begin anew', this.line, async () => { await post('/api/board/restart'); this.map.replaceChildren(); return 'no views'; }, { 'data-writes': '' })),
    el('div', { class: 'two-columns' }, picture, this.map));
  }

  async #watch() {
    while (this.looking.checked && !this.panel.hidden) {
      try {
        this.line.textContent = this.#show(await post('/api/board/look', this.board()));
      } catch (error) {
        this.line.textContent = error.message;
      }
      await new Promise((done) => setTimeout(done, LOOK_MS));
    }
    this.looking.checked = false;
  }

  #show(found) {
    this.corners.replaceChildren(...found.corners.map(([x, y]) => svg('circle', { cx: x, cy: y, r: found.width / 120, class: 'light front fill-guide' })));
    this.#drawMap(found.coverage);
    return `${found.corners.length ? `board seen, ${found.corners.length} corners` : 'no board in the picture'}; ${found.taken} views taken`;
  }

  #drawMap(coverage) {
    this.map.replaceChildren(...coverage.flat().map((n) => el('span', { class: n >= ENOUGH ? 'enough' : '' }, n >= ENOUGH ? `✓ ${n}` : String(n))));
  }

  async #solve(tell) {
    const found = await ended(await post('/api/board/solve', { ...this.board(), model: this.model.value }), (state) => tell(`${state} …`));
    const pair = (values, digits) => values.map((x) => x.toFixed(digits)).join(', ');
    const map = el('div');
    this.out.replaceChildren(
      table(['', 'found', 'in use'], [
        ['focal length, px', `${pair(found.focal_px, 1)} ± ${pair(found.sigma.slice(0, 2), 1)}`, pair(found.in_use.focal_px, 1)],
        ['centre, px', `${pair(found.center_px, 1)} ± ${pair(found.sigma.slice(2, 4), 1)}`, pair(found.in_use.center_px, 1)],
        ['residual, px rms', `${found.rms_px.toFixed(3)}; ${found.held_out_px.toFixed(3)} in views held out`, '']]),
      found.advice.length ? el('ul', {}, ...found.advice.map((text) => el('li', {}, `Add: ${text}.`))) : el('p', {}, '✓ The views cover the picture.'),
      map, saver('calibration', '/home/me/camera.yaml'));
    if (this.about.mode !== 'live') map.append(this.map);
    this.#drawMap(found.coverage);
    return 'solved; nothing is written until you save it';
  }
}
