// Contrast of every text with what is behind it, what sticks out of the page, buttons too small for a finger, and
// fields without a name; transparent grounds are looked through.
() => {
  const channel = (c) => (c / 255 <= 0.03928 ? c / 255 / 12.92 : ((c / 255 + 0.055) / 1.055) ** 2.4);
  const shine = ([r, g, b]) => 0.2126 * channel(r) + 0.7152 * channel(g) + 0.0722 * channel(b);
  const parts = (text) => text.match(/[\d.]+/g).map(Number);
  const ground = (node) => {
    for (let at = node; at; at = at.parentElement) {
      const found = parts(getComputedStyle(at).backgroundColor);
      if (found.length < 4 || found[3] > 0.5) return found;
    }
    return [255, 255, 255];
  };
  const bad = [];
  const shown = (node) => node.checkVisibility({ checkVisibilityCSS: true });
  for (const node of document.querySelectorAll('body *')) {
    const text = [...node.childNodes].some((child) => child.nodeType === 3 && child.textContent.trim());
    if (!shown(node) || node.closest('.picture, svg, :disabled')) continue;
    if (text) {
      const [one, two] = [shine(parts(getComputedStyle(node).color)), shine(ground(node))];
      const contrast = (Math.max(one, two) + 0.05) / (Math.min(one, two) + 0.05);
      if (contrast < 4.5) bad.push(`contrast ${contrast.toFixed(1)}: ${node.textContent.slice(0, 30)}`);
    }
    if (node.matches('button, select, input:not([type=checkbox]):not([type=range])') && node.getBoundingClientRect().height < 24) bad.push(`small: ${node.outerHTML.slice(0, 60)}`);
    if (node.matches('input, select, textarea') && !(node.labels?.length || node.ariaLabel)) bad.push(`no name: ${node.outerHTML.slice(0, 60)}`);
  }
  if (document.documentElement.scrollWidth > window.innerWidth) bad.push(`wider than the screen: ${document.documentElement.scrollWidth}`);
  return bad;
}
