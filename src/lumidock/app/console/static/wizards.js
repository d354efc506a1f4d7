// Dock check, calibration in water and dock survey, step by step; each ends in the command of the same purpose.

import { action, el, ended, get, getBlob, mayWrite, number, post, svg } from './api.js';
import { FrameView } from './frame.js';

const ENOUGH = 20; // corners in a cell, as calib water advises
const LOOK_MS = 800;

function table(titles, rows) {
  return el('div', { class: 'scroll' }, el('table', {},
    el('thead', {}, el('tr', {}, ...titles.map((title) => el('th', { scope: 'col' }, title)))),
    el('tbody', {}, ...rows.map((row) => el('tr', {}, ...row.map((cell) => el('td', {}, cell)))))));
}

function needsToken() {
  return mayWrite ? null : el('p', { class: 'bad' }, 'This needs the address with #token= that the command printed.');
}

// Where a result goes: a path, a box to replace what is there, and a button.
function saver(kind, placeholder) {
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
    this.confirmed = new Set();
    panel.append(el('div', { class: 'card' }, el('h2', {}, 'Dock survey'),
      el('p', {}, 'The true positions of the lights from this recording, as lumidock survey finds them. 1. Confirm in three frames that each light carries its own id. 2. Tape one distance between two lights far apart. 3. Solve, and look at the residuals.'),
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
    const right = el('input', { type: 'checkbox', onchange: () => (right.checked ? this.confirmed.add(index) : this.confirmed.delete(index)) });
    const card = el('div', { class: 'card' }, el('h3', {}, `Frame ${index + 1}`), view.picture, view.hint, el('label', {}, right, 'every light carries its own id'));
    requestAnimationFrame(() => view.update(state, jpeg));
    return card;
  }

  async #solve(tell) {
    if (!this.wanted || this.confirmed.size < this.wanted) throw new Error('confirm the frames first; where a light carries a wrong id, state how far off the drawing is and run again');
    const asked = { off_m: Number(this.off.value.replace(',', '.')) };
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
