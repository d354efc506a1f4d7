// Requests to the server, the token, and the few ways in which the page makes elements.

const hash = new URLSearchParams(location.hash.slice(1));
if (hash.has('token')) {
  sessionStorage.setItem('token', hash.get('token'));
  history.replaceState(null, '', location.pathname);
}
export const token = sessionStorage.getItem('token') ?? '';
export const mayWrite = token !== '';

function headers(more = {}) {
  return token ? { Authorization: `Bearer ${token}`, ...more } : more;
}

async function refused(answer) {
  let text = `${answer.status} ${answer.statusText}`;
  try {
    text = (await answer.json()).error ?? text;
  } catch { /* no JSON: the status says it */ }
  return new Error(text);
}

export async function get(path) {
  const answer = await fetch(path, { headers: headers() });
  if (!answer.ok) throw await refused(answer);
  return answer.json();
}

export async function getBlob(path) {
  const answer = await fetch(path, { headers: headers() });
  if (!answer.ok) throw await refused(answer);
  return answer.status === 204 ? null : answer.blob();
}

export async function post(path, content = {}) {
  const answer = await fetch(path, {
    method: 'POST',
    headers: headers({ 'Content-Type': 'application/json' }),
    body: JSON.stringify(content),
  });
  if (!answer.ok) throw await refused(answer);
  return answer.json();
}

const sleep = (ms) => new Promise((done) => setTimeout(done, ms));

// The result of a job once it has ended; `told` is called with its state meanwhile.
export async function ended(job, told = () => {}) {
  let now = job;
  while (now.state === 'waiting' || now.state === 'running') {
    told(now.state);
    await sleep(400);
    now = await get(`/api/jobs/${job.number}`);
  }
  if (now.state === 'failed') throw new Error(now.line);
  return now.result;
}

export function liveSocket() {
  const scheme = location.protocol === 'https:' ? 'wss' : 'ws';
  const socket = new WebSocket(`${scheme}://${location.host}/api/live`, ['lumidock', ...(token ? [`token.${token}`] : [])]);
  socket.binaryType = 'arraybuffer';
  return socket;
}

// An element: el('p', {class: 'x', onclick: f}, 'text', child, ...).
export function el(name, attributes = {}, ...children) {
  return filled(document.createElement(name), attributes, children);
}

export function svg(name, attributes = {}, ...children) {
  return filled(document.createElementNS('http://www.w3.org/2000/svg', name), attributes, children);
}

function filled(node, attributes, children) {
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith('on')) node.addEventListener(key.slice(2), value);
    else if (value === true) node.setAttribute(key, '');
    else if (value !== false && value !== null && value !== undefined) node.setAttribute(key, value);
  }
  node.append(...children.filter((child) => child !== null && child !== undefined));
  return node;
}

export function number(value, digits = 2, unit = '') {
  return value === null || value === undefined ? '–' : `${value.toFixed(digits)}${unit ? ` ${unit}` : ''}`;
}

export function saveAs(blob, name) {
  const url = URL.createObjectURL(blob);
  const link = el('a', { href: url, download: name });
  document.body.append(link);
  link.click();
  link.remove();
  setTimeout(() => URL.revokeObjectURL(url), 10000);
}

// A button that runs something slow: it is disabled meanwhile, and `line` tells how it ended.
export function action(label, line, run, attributes = {}) {
  const button = el('button', { type: 'button', ...attributes }, label);
  button.addEventListener('click', async () => {
    button.disabled = true;
    line.classList.remove('bad');
    try {
      const text = await run((told) => { line.textContent = told; });
      line.textContent = text ?? '';
    } catch (error) {
      line.textContent = error.message;
      line.classList.add('bad');
    } finally {
      button.disabled = false;
    }
  });
  if (!mayWrite && attributes['data-writes'] !== undefined) {
    button.disabled = true;
    button.title = 'Open the address with #token= that the command printed, to use this.';
  }
  return button;
}
