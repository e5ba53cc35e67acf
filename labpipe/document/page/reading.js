// Reading values: the cursor follows the pointer or the arrow keys; what it stands on is told in words beside it.
// With more values than this, those of the panel under the cursor are told.
const MOST_LINES = 9;

function nearestIn(panel, x, y) {
  let best = null;
  for (const one of panel.shown()) {
    if (one.kind === "cells") return nearestCell(panel, one, x, y);
    if (one.kind !== "line") continue;
    const points = one.pixels;
    for (let n = 0; n < points.length; n += 1) {
      if (!points[n] || points[n][0] < panel.box.left - 1 || points[n][0] > panel.box.right + 1) continue;
      const away = Math.abs(points[n][0] - x) + (panel.orderly ? 0.001 : 1) * Math.abs(points[n][1] - y);
      if (best === null || away < best.away) best = { away, one, n, x: one.x[n] };
    }
  }
  return best;
}

function nearestCell(panel, one, x, y) {
  const row = Math.min(Math.max(Math.round(panel.scale.y.value(y)), 0), one.values.length - 1);
  const column = Math.min(Math.max(Math.round(panel.scale.x.value(x)), 0), one.values[0].length - 1);
  return { one, row, column, x: column };
}

function linesOf(panel, place) {
  const { spec } = panel;
  const lines = [];
  for (const one of panel.shown()) {
    if (one.kind !== "line") continue;
    const n = panel.orderly ? closest(one, panel, place.x) : one === place.one ? place.n : -1;
    if (n < 0 || (one.y[n] === null && one.low?.[n] === null)) continue;
    const value = one.y[n] === null ? "" : ` ${reading(one.y[n], spec.y.unit)}`;
    const between = one.low && one.low[n] !== null ? ` (${one.interval} ${reading(one.low[n])} to ${reading(one.high[n])})` : "";
    lines.push({ text: `${one.name}:${value}${between}`, colour: inkOf(one.colour), at: one.pixels[n] });
  }
  return lines;
}

function closest(one, panel, x) {
  let best = -1;
  for (let n = 0; n < one.x.length; n += 1) {
    if (one.x[n] !== null && (best < 0 || Math.abs(one.x[n] - x) < Math.abs(one.x[best] - x))) best = n;
  }
  const { pixel } = panel.scale.x;
  return best >= 0 && Math.abs(pixel(one.x[best]) - pixel(x)) < 9 ? best : -1;
}

function nameOf(axis, value) {
  const named = axis.ticks.find(([place]) => Math.abs(place - value) < 0.5);
  return named ? named[1] : `${axis.title} ${reading(value, axis.unit)}`;
}

function showReading(figure, panel, place) {
  figure.place = { panel, ...place };
  const { spec } = panel;
  figure.box.replaceChildren();
  if (place.one.kind === "cells") {
    const words = place.one.texts[place.row][place.column].replace("\n", " ");
    node("b", { textContent: `${nameOf(spec.y, place.row)}, ${nameOf(spec.x, place.column)}: ${words}` }, figure.box);
  } else {
    node("b", { textContent: (spec.title ? `${spec.title}, ` : "") + nameOf(spec.x, place.x) }, figure.box);
  }
  const along = figure.panels.filter((other) => other === panel || (panel.orderly && other.orderly && other.spec.x.group === spec.x.group));
  for (const other of figure.panels) other.cursor.replaceChildren();
  if (place.one.kind !== "cells") tell(figure, panel, place, along);
  placeBox(figure, panel, place);
}

function tell(figure, panel, place, along) {
  const told = along.map((other) => [other, linesOf(other, place)]);
  const brief = told.reduce((sum, [, lines]) => sum + lines.length, 0) > MOST_LINES;
  for (const [other, lines] of told) {
    const x = other.scale.x.pixel(place.x);
    element("path", { d: `M${x} ${other.box.top}V${other.box.bottom}` }, other.cursor);
    for (const line of lines) {
      if (line.at) element("circle", { cx: line.at[0], cy: line.at[1], r: 5, style: `--own: ${line.colour}` }, other.cursor);
      if (brief && other !== panel) continue;
      const named = line.text.startsWith(other.spec.y.title) || brief || figure.panels.length === 1;
      node("span", { textContent: named ? line.text : `${other.spec.y.title}, ${line.text}`, style: `--own: ${line.colour}` }, figure.box);
    }
  }
}

function placeBox(figure, panel, place) {
  figure.box.hidden = false;
  const [whole, own] = [figure.live.getBoundingClientRect(), panel.svg.getBoundingClientRect()];
  const at = own.left - whole.left + panel.scale.x.pixel(place.x);
  const width = figure.box.offsetWidth;
  const left = at + 14 + width < whole.width ? at + 14 : Math.max(0, at - 14 - width);
  figure.box.style.left = `${left}px`;
  figure.box.style.top = `${own.top - whole.top + panel.box.top + 4}px`;
}

function hideReading(figure) {
  figure.box.hidden = true;
  for (const panel of figure.panels) panel.cursor.replaceChildren();
}

function step(figure, panel, by) {
  const first = panel.shown().find((one) => one.kind === "line" || one.kind === "cells");
  if (!first) return;
  const here = figure.place && figure.place.panel === panel && panel.shown().includes(figure.place.one) ? figure.place : null;
  if (first.kind === "cells") stepCell(figure, panel, first, here, by);
  else if (panel.orderly) stepAlong(figure, panel, first, here, by[0] || 0);
  else {
    const one = here ? here.one : first;
    const n = here ? (here.n + (by[0] || by[1]) + one.x.length) % one.x.length : 0;
    showReading(figure, panel, { one, n, x: one.x[n] });
  }
}

function stepAlong(figure, panel, first, here, by) {
  const [low, high] = panel.limits.x;
  // Keys go from point to point; a curve alone has many where it bends, so that it is stepped along only where there are no points.
  const curves = panel.shown().filter((one) => one.kind === "line");
  const dotted = curves.filter((one) => one.marker);
  const places = [...new Set((dotted.length ? dotted : curves).flatMap((one) => one.x))]
    .filter((x) => x !== null && x >= low && x <= high).sort((a, b) => a - b);
  if (!places.length) return;
  const now = here ? places.findIndex((x) => x >= here.x) : by > 0 ? -1 : places.length;
  const next = Math.min(Math.max((now < 0 && here ? places.length : now) + by, 0), places.length - 1);
  showReading(figure, panel, { one: first, n: 0, x: places[next] });
}

function stepCell(figure, panel, one, here, by) {
  const bound = (value, most) => Math.min(Math.max(value, 0), most - 1);
  const row = here ? bound(here.row + by[1], one.values.length) : 0;
  const column = here ? bound(here.column + by[0], one.values[0].length) : 0;
  showReading(figure, panel, { one, row, column, x: column });
}
