// Starts the parts that fit: a live camera or a recording, and the tabs beside it.

import { el, get } from './api.js';
import { Live } from './live.js';
import { Replay } from './replay.js';
import { Settings } from './settings.js';
import { SurveyWizard } from './survey.js';
import { CalibrateWizard, dockCheck } from './wizards.js';

const byId = (id) => document.getElementById(id);
const KEYS = {
  live: [['1 – 4', 'the parts of the console'], ['?', 'this list']],
  replay: [['← →', 'one frame back or on; with shift ten'], ['space', 'play or stop'], ['n  p', 'next or last loss or alarm'], ['b', 'bookmark this frame'],
    ['i  o', 'start or end of the stretch'], ['Home  End', 'first or last frame'], ['1 – 5', 'the parts of the console'], ['?', 'this list']],
};

function tabs(names, opened) {
  const buttons = names.map(([id, title]) => el('button', { type: 'button', role: 'tab', id: `tab-${id}`, 'aria-controls': `panel-${id}`, onclick: () => open(id) }, title));
  function open(id) {
    for (const [k, [name]] of names.entries()) {
      byId(`panel-${name}`).hidden = name !== id;
      buttons[k].setAttribute('aria-selected', String(name === id));
      buttons[k].tabIndex = name === id ? 0 : -1;
    }
    opened(id);
  }
  byId('tabs').append(...buttons);
  byId('tabs').addEventListener('keydown', (event) => {
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (!step) return;
    event.stopPropagation();
    const next = buttons[(buttons.indexOf(document.activeElement) + step + buttons.length) % buttons.length];
    next.focus();
    next.click();
  });
  open(names[0][0]);
  return open;
}

async function start() {
  const about = await get('/api/about');
  const live = about.mode === 'live';
  byId('dock').textContent = `${about.station}, ${about.method}, ${about.version}`;
  const places = { frames: byId('frames'), below: byId('below'), replay: byId('replay') };
  byId('panel-view').hidden = false;
  const shown = live ? new Live(about, places, byId('problem')) : new Replay(about, places);
  const settings = new Settings(about, byId('panel-settings'), live ? null : shown);
  dockCheck(about, byId('panel-check'));
  new CalibrateWizard(about, byId('panel-calibrate'));
  if (!live) new SurveyWizard(about, byId('panel-survey'), shown);
  const names = [['view', live ? 'Live' : 'Replay'], ['settings', 'Settings'], ['check', 'Dock check'], ['calibrate', 'Calibrate'], ...(live ? [] : [['survey', 'Survey']])];
  const open = tabs(names, (id) => { if (id === 'settings') settings.keep(); });
  byId('keys').append(...KEYS[about.mode].flatMap(([key, text]) => [el('dt', {}, el('kbd', {}, key)), el('dd', {}, text)]));
  byId('help-button').addEventListener('click', () => byId('help').showModal());
  document.addEventListener('keydown', (event) => {
    if (event.target.closest('input:not([type=range]), textarea, select, dialog') || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key === '?') byId('help').showModal();
    else if (names[Number(event.key) - 1]) open(names[Number(event.key) - 1][0]);
    else if (!live && !byId('panel-view').hidden && !(event.key === ' ' && event.target.closest('button, summary'))) shown.key(event);
  });
}

start().catch((error) => {
  byId('problem').hidden = false;
  byId('problem').textContent = error.message;
});
