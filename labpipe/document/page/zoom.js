// Zoom: a box drawn with the pointer, the wheel, buttons and keys; axes that are shared move together.
function setLimits(figure, panel, which, limits) {
  if (!(Math.abs(limits[1] - limits[0]) > 1e-12 * Math.max(Math.abs(limits[0]), Math.abs(limits[1]), 1e-300)) || !limits.every(Number.isFinite)) return;
  for (const other of figure.panels) {
    if (other === panel || other.spec[which].group === panel.spec[which].group) other.limits[which] = [...limits];
  }
}

function zoomAbout(figure, panel, which, share, factor) {
  const { box } = panel;
  const [from, to] = which === "x" ? [box.left, box.right] : [box.bottom, box.top];
  const fixed = from + share * (to - from);
  const scale = panel.scale[which];
  setLimits(figure, panel, which, [scale.value(fixed + (from - fixed) * factor), scale.value(fixed + (to - fixed) * factor)]);
  figure.draw();
}

function shift(figure, panel, share) {
  const { box, scale } = panel;
  const by = share * (box.right - box.left);
  setLimits(figure, panel, "x", [scale.x.value(box.left + by), scale.x.value(box.right + by)]);
  figure.draw();
}

function showAll(figure) {
  for (const panel of figure.panels) panel.limits = { x: [...panel.spec.x.limits], y: [...panel.spec.y.limits] };
  figure.draw();
}

function zoomToBox(figure, panel, start, end) {
  const { scale } = panel;
  const spans = { x: [start[0], end[0]].sort((a, b) => a - b), y: [start[1], end[1]].sort((a, b) => b - a) };
  const wide = spans.x[1] - spans.x[0] > 6;
  const high = spans.y[0] - spans.y[1] > 12;
  if (wide) setLimits(figure, panel, "x", spans.x.map(scale.x.value));
  if (high) setLimits(figure, panel, "y", spans.y.map(scale.y.value));
  if (wide || high) figure.draw();
  return wide || high;
}

function placeOf(panel, event) {
  const own = panel.svg.getBoundingClientRect();
  return [event.clientX - own.left, event.clientY - own.top];
}

function follow(figure, panel) {
  const { svg } = panel;
  let start = null;
  let frame = null;
  svg.addEventListener("pointerdown", (event) => {
    if (event.button !== 0 || event.pointerType === "touch") return;
    start = placeOf(panel, event);
  });
  svg.addEventListener("pointermove", (event) => {
    const [x, y] = placeOf(panel, event);
    if (start === null) {
      const place = nearestIn(panel, x, y);
      if (place) showReading(figure, panel, place);
      return;
    }
    frame = frame || element("rect", { class: "box" }, svg);
    const box = { x: Math.min(x, start[0]), y: Math.min(y, start[1]), width: Math.abs(x - start[0]), height: Math.abs(y - start[1]) };
    for (const [key, value] of Object.entries(box)) frame.setAttribute(key, value);
  });
  const end = (event) => {
    const from = start;
    start = null;
    frame?.remove();
    frame = null;
    if (!from || event.type !== "pointerup") return;
    const to = placeOf(panel, event);
    if (!zoomToBox(figure, panel, from, to)) choose(figure, panel, nearestIn(panel, ...to));
  };
  svg.addEventListener("pointerup", end);
  svg.addEventListener("pointercancel", end);
  svg.addEventListener("pointerleave", (event) => { if (start) end(event); hideReading(figure); });
  svg.addEventListener("dblclick", () => showAll(figure));
  svg.addEventListener("wheel", (event) => wheel(figure, panel, event), { passive: false });
  svg.addEventListener("keydown", (event) => key(figure, panel, event));
  svg.addEventListener("blur", () => hideReading(figure));
}

function wheel(figure, panel, event) {
  // Without focus the wheel scrolls the page, as everywhere.
  if (!event.ctrlKey && document.activeElement !== panel.svg) return;
  event.preventDefault();
  const [x, y] = placeOf(panel, event);
  const { box } = panel;
  const which = event.shiftKey ? "y" : "x";
  const share = which === "x" ? (x - box.left) / (box.right - box.left) : (box.bottom - y) / (box.bottom - box.top);
  zoomAbout(figure, panel, which, Math.min(Math.max(share, 0), 1), 1.2 ** Math.sign(event.deltaY || event.deltaX));
}

function key(figure, panel, event) {
  const moves = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1], Home: [-1e6, 0], End: [1e6, 0] };
  if (event.altKey || event.ctrlKey || event.metaKey) return;
  if (event.shiftKey && event.key in moves && moves[event.key][0]) shift(figure, panel, 0.2 * Math.sign(moves[event.key][0]));
  else if (event.key in moves && (moves[event.key][0] || !panel.orderly)) step(figure, panel, moves[event.key]);
  else if (event.key === "+" || event.key === "=") zoomAbout(figure, panel, "x", shareOfCursor(figure, panel), 0.7);
  else if (event.key === "-") zoomAbout(figure, panel, "x", shareOfCursor(figure, panel), 1 / 0.7);
  else if (event.key === "Enter" && panel.spec.pick && !figure.box.hidden) choose(figure, panel, figure.place);
  else if (event.key === "0" || event.key === "Escape") { hideReading(figure); showAll(figure); }
  else return;
  event.preventDefault();
}

function shareOfCursor(figure, panel) {
  if (!figure.place || figure.place.panel !== panel || figure.box.hidden) return 0.5;
  const share = (panel.scale.x.pixel(figure.place.x) - panel.box.left) / (panel.box.right - panel.box.left);
  return Math.min(Math.max(share, 0), 1);
}
