// One panel: frame, ticks, and the series inside their limits.
const DASHES = { "-": "", "--": "6 3", ":": "1.5 3", "-.": "7 3 1.5 3" };
// What lies below what, by kind: shades under curves, arrows over them.
const DEPTHS = { cells: 0, hspan: 0, area: 1, hline: 2, vline: 2, line: 3, arrow: 4, text: 4 };
// From -1 to 1: orange, white, violet, of one lightness at both ends (ColorBrewer's PuOr).
const HEAT = ["7f3b08", "b35806", "e08214", "fdb863", "fee0b6", "f7f7f7", "d8daeb", "b2abd2", "8073ac", "542788", "2d004b"]
  .map((tone) => [0, 2, 4].map((at) => parseInt(tone.slice(at, at + 2), 16)));
const LETTER = 6.6;
const SCALE_ROOM = 72;

function inkOf(colour) {
  return typeof colour === "number" ? `var(--c${colour})` : colour;
}

function heatOf(value) {
  const at = ((Math.min(Math.max(value, -1), 1) + 1) / 2) * (HEAT.length - 1);
  const step = Math.min(Math.floor(at), HEAT.length - 2);
  return HEAT[step].map((part, n) => Math.round(part + (at - step) * (HEAT[step + 1][n] - part)));
}

function cellsOf(panel) {
  return panel.spec.series.find((one) => one.kind === "cells");
}

function marginsOf(panel, lowest) {
  const most = Math.max(3, Math.floor(panel.height / 42));
  const labels = ticksOf(panel.spec.y, panel.limits.y, most).map(([, text]) => text.length);
  const bottom = lowest ? (panel.spec.x.label ? 38 : 22) + panel.names.height : 12;
  // The first of slanted names reaches to the left of its axis.
  const left = Math.max(26 + LETTER * Math.max(1, ...labels), lowest ? panel.names.aside : 0);
  return { left, right: cellsOf(panel) ? SCALE_ROOM : 14, top: panel.spec.title ? 22 : 8, bottom, most };
}

// Names of places that do not fit beside each other are turned [deg]; height, aside: of the room that they then need.
function namesOf(panel, width) {
  const names = panel.spec.x.ticks.map(([, name]) => LETTER * name.length + 6);
  const longest = Math.max(0, ...names);
  const room = (0.8 * width) / Math.max(names.length, 1);
  if (longest <= room) return { turned: 0, height: 0, aside: 0 };
  const turned = cellsOf(panel) || room < 28 ? 90 : 30;
  const angle = (turned * Math.PI) / 180;
  return { turned, height: longest * Math.sin(angle), aside: Math.min(0.9 * names[0] * Math.cos(angle), width / 4) };
}

function drawPanel(panel, width, left, lowest) {
  const { svg, spec, height } = panel;
  const margins = { ...panel.margins, left };
  panel.box = { left, right: width - margins.right, top: margins.top, bottom: height - margins.bottom };
  if (spec.equal) keepEqual(panel);
  panel.scale = {
    x: scaleOf(panel.limits.x, spec.x.log, panel.box.left, panel.box.right),
    y: scaleOf(panel.limits.y, spec.y.log, panel.box.bottom, panel.box.top),
  };
  svg.replaceChildren();
  svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
  svg.setAttribute("height", height);
  drawFrame(panel, margins, lowest);
  const clip = element("clipPath", { id: `${panel.id}-clip` }, svg);
  const { box } = panel;
  element("rect", { x: box.left, y: box.top, width: box.right - box.left, height: box.bottom - box.top }, clip);
  const inside = element("g", { "clip-path": `url(#${panel.id}-clip)`, class: "series" }, svg);
  for (const one of panel.shown().sort((a, b) => DEPTHS[a.kind] - DEPTHS[b.kind])) drawSeries(panel, one, inside);
  if (cellsOf(panel)) drawScale(panel, cellsOf(panel).scale);
  panel.cursor = element("g", { class: "cursor" }, svg);
}

function keepEqual(panel) {
  const { box, limits } = panel;
  const perPixel = Math.max((limits.x[1] - limits.x[0]) / (box.right - box.left), (limits.y[1] - limits.y[0]) / (box.bottom - box.top));
  for (const [which, pixels] of [["x", box.right - box.left], ["y", box.bottom - box.top]]) {
    const middle = (limits[which][0] + limits[which][1]) / 2;
    limits[which] = [middle - (perPixel * pixels) / 2, middle + (perPixel * pixels) / 2];
  }
}

function drawFrame(panel, margins, lowest) {
  const { svg, spec, box, scale, limits } = panel;
  const across = ticksOf(spec.x, limits.x, Math.max(2, Math.floor((box.right - box.left) / 75)));
  const grid = element("g", { class: "grid" }, svg);
  const texts = element("g", { class: "ticks" }, svg);
  across.forEach(([value, label], number) => {
    const x = scale.x.pixel(value);
    element("path", { d: `M${x} ${box.top}V${box.bottom}` }, grid);
    if (!lowest) return;
    const room = (box.right - box.left) / Math.max(across.length, 1);
    const { turned } = panel.names;
    const step = Math.ceil((turned ? 14 : LETTER * label.length + 6) / room);
    if (number % step !== 0) return;
    const [at, down] = turned === 90 ? [x + 4, box.bottom + 8] : [x, box.bottom + 14];
    const look = turned ? { "text-anchor": "end", transform: `rotate(${-turned} ${at} ${down})` } : { "text-anchor": "middle" };
    element("text", { x: at, y: down, ...look }, texts).textContent = label;
  });
  for (const [value, label] of ticksOf(spec.y, limits.y, margins.most)) {
    const y = scale.y.pixel(value);
    element("path", { d: `M${box.left} ${y}H${box.right}` }, grid);
    element("text", { x: box.left - 5, y: y + 4, "text-anchor": "end" }, texts).textContent = label;
  }
  element("path", { class: "frame", d: `M${box.left} ${box.top}V${box.bottom}H${box.right}` }, svg);
  // A name longer than the panel is pressed to its height; one that is nearly as long leaves the middle of the axis.
  const length = Math.min(6.4 * spec.y.label.length, panel.height - 8);
  const centre = Math.max(Math.min((box.top + box.bottom) / 2, panel.height - length / 2 - 3), length / 2 + 3);
  if (spec.title) element("text", { class: "title", x: (box.left + box.right) / 2, y: 14, "text-anchor": "middle" }, svg).textContent = spec.title;
  if (lowest) element("text", { x: (box.left + box.right) / 2, y: box.bottom + margins.bottom - 7, "text-anchor": "middle" }, svg).textContent = spec.x.label;
  const upright = element("text", { x: 12, y: centre, "text-anchor": "middle", transform: `rotate(-90 12 ${centre})` }, svg);
  upright.textContent = spec.y.label;
  if (length === panel.height - 8) {
    upright.setAttribute("textLength", length);
    upright.setAttribute("lengthAdjust", "spacingAndGlyphs");
  }
}

function drawSeries(panel, one, inside) {
  const group = element("g", { style: `--own: ${inkOf(one.colour)}` }, inside);
  if (one.kind === "cells") drawCells(panel, one, group);
  else if (one.kind === "area") drawArea(panel, one, group);
  else if (one.kind === "text") drawText(panel, one, group);
  else if (one.kind === "arrow") drawArrow(panel, one, group);
  else if (one.kind !== "line") drawAcross(panel, one, group);
  else drawCurve(panel, one, group);
}

function drawCurve(panel, one, group) {
  const points = panel.pixels(one, one.y);
  if (one.interval === "shaded") {
    const ends = [panel.pixels(one, one.low), panel.pixels(one, one.high)];
    for (const run of runsOf(ends[0], ends[1])) {
      const path = [...run.map((n) => ends[0][n]), ...run.reverse().map((n) => ends[1][n])];
      element("path", { class: "shade", d: `M${path.map((point) => point.join(" ")).join("L")}Z`, ...shadeOf(one) }, group);
    }
  }
  if (one.interval === "bar") drawBars(panel, one, group);
  if (one.line) {
    const runs = runsOf(points, points).map((run) => `M${run.map((n) => points[n].join(" ")).join("L")}`);
    element("path", { class: "curve", d: runs.join(""), "stroke-dasharray": DASHES[one.line] || "", "stroke-width": Math.max(one.width, 1) * 1.2 }, group);
  }
  if (one.marker) drawDots(one, points, group);
}

function shadeOf(one) {
  return { style: `fill-opacity: ${one.opacity}` };
}

function drawDots(one, points, group) {
  const there = points.filter((point) => point);
  if (one.hollow || one.marker === "v") {
    const r = Math.max(one.size, 3) / 1.6;
    const round = `m${-r} 0a${r} ${r} 0 1 0 ${2 * r} 0a${r} ${r} 0 1 0 ${-2 * r} 0z`;
    const shape = { v: `m${-r} ${-r}h${2 * r}l${-r} ${2 * r}z`, s: `m${-r} ${-r}h${2 * r}v${2 * r}h${-2 * r}z` }[one.marker] || round;
    element("path", { class: one.hollow ? "hollow" : "head", d: there.map((point) => `M${point.join(" ")}${shape}`).join("") }, group);
    return;
  }
  const cap = one.marker === "s" ? "square" : "round";
  element("path", { class: "dots", d: there.map((point) => `M${point.join(" ")}h0`).join(""), "stroke-linecap": cap, "stroke-width": Math.max(one.size * 1.3, 3.4) }, group);
}

function drawBars(panel, one, group) {
  const [low, high] = [panel.pixels(one, one.low), panel.pixels(one, one.high)];
  const bars = low.map((point, n) => (point && high[n] ? `M${point[0]} ${point[1]}V${high[n][1]}M${point[0] - 4} ${point[1]}h8M${point[0] - 4} ${high[n][1]}h8` : ""));
  element("path", { class: "curve", d: bars.join(""), "stroke-width": 1.3 }, group);
}

function drawArea(panel, one, group) {
  const points = panel.pixels(one, one.y).filter((point) => point);
  const edge = one.width ? `stroke: var(--rule); stroke-width: ${1.3 * one.width};` : "";
  element("path", { class: "shade", d: `M${points.map((point) => point.join(" ")).join("L")}Z`, style: `${edge}fill-opacity: ${one.opacity}` }, group);
}

function drawAcross(panel, one, group) {
  const { box, scale } = panel;
  const flat = one.kind.startsWith("h");
  const places = (flat ? one.y : one.x).map((value) => (flat ? scale.y : scale.x).pixel(value));
  if (one.kind === "hspan") {
    const [near, far] = [Math.min(...places), Math.max(...places)];
    element("rect", { class: "shade", x: box.left, y: near, width: box.right - box.left, height: far - near, ...shadeOf(one) }, group);
    return;
  }
  const path = flat ? `M${box.left} ${places[0]}H${box.right}` : `M${places[0]} ${box.top}V${box.bottom}`;
  element("path", { class: "curve", d: path, "stroke-dasharray": DASHES[one.line] || "", "stroke-width": one.width * 1.2 }, group);
  if (flat && one.name) element("text", { x: box.right - 3, y: places[0] - 3, "text-anchor": "end" }, group).textContent = one.name;
}

function drawArrow(panel, one, group) {
  const [tail, head] = panel.pixels(one, one.y);
  if (!tail || !head) return;
  const long = Math.hypot(head[0] - tail[0], head[1] - tail[1]) || 1;
  const [x, y] = [(head[0] - tail[0]) / long, (head[1] - tail[1]) / long];
  const corners = [[head[0] + 5 * x, head[1] + 5 * y], [head[0] - 5 * x - 4 * y, head[1] - 5 * y + 4 * x], [head[0] - 5 * x + 4 * y, head[1] - 5 * y - 4 * x]];
  element("path", { class: "curve", d: `M${tail.join(" ")}L${head.join(" ")}`, "stroke-width": 1.3 }, group);
  element("path", { class: "head", d: `M${corners.map((corner) => corner.join(" ")).join("L")}Z` }, group);
}

function drawText(panel, one, group) {
  panel.pixels(one, one.y).forEach((point, n) => {
    if (!point) return;
    const look = { x: point[0], y: point[1] + 4, "text-anchor": "middle", style: `fill: var(--own); font-size: ${1.3 * one.size}px` };
    element("text", look, group).textContent = one.texts[n];
  });
}

function drawCells(panel, one, group) {
  const { x, y } = panel.scale;
  one.values.forEach((row, r) => row.forEach((value, c) => {
    const [left, right] = [x.pixel(c - 0.5), x.pixel(c + 0.5)].sort((a, b) => a - b);
    const [top, bottom] = [y.pixel(r - 0.5), y.pixel(r + 0.5)].sort((a, b) => a - b);
    const [red, green, blue] = value === null ? [255, 255, 255] : heatOf(value);
    element("rect", { x: left, y: top, width: right - left, height: bottom - top, style: `fill: rgb(${red}, ${green}, ${blue})` }, group);
    const lines = one.texts[r][c].split("\n");
    if (right - left < LETTER * Math.max(...lines.map((line) => line.length))) return;
    const ink = red * 0.3 + green * 0.59 + blue * 0.11 < 128 ? "#fff" : "#000";
    lines.slice(0, Math.max(1, Math.floor((bottom - top) / 14))).forEach((line, n, shown) => {
      const down = (top + bottom) / 2 + 4 + 13 * (n - (shown.length - 1) / 2);
      element("text", { x: (left + right) / 2, y: down, "text-anchor": "middle", style: `fill: ${ink}` }, group).textContent = line;
    });
  }));
}

// The colours from -1 to 1 with their numbers and what they say, right of the matrix.
function drawScale(panel, title) {
  const { svg, box } = panel;
  const [left, high, steps] = [box.right + 10, box.bottom - box.top, 40];
  for (let n = 0; n < steps; n += 1) {
    const look = { x: left, y: box.bottom - ((n + 1) * high) / steps, width: 10, height: high / steps + 0.5 };
    element("rect", { ...look, style: `fill: rgb(${heatOf((2 * n + 1) / steps - 1)})` }, svg);
  }
  for (const value of [-1, -0.5, 0, 0.5, 1]) {
    element("text", { x: left + 14, y: box.bottom - ((value + 1) / 2) * high + 4 }, svg).textContent = plain(value);
  }
  const middle = [box.right + SCALE_ROOM - 4, (box.top + box.bottom) / 2];
  element("text", { x: middle[0], y: middle[1], "text-anchor": "middle", transform: `rotate(-90 ${middle})` }, svg).textContent = title;
}

function runsOf(first, second) {
  const runs = [];
  let run = [];
  first.forEach((point, n) => {
    if (point && second[n]) run.push(n);
    else if (run.length) { runs.push(run); run = []; }
  });
  if (run.length) runs.push(run);
  return runs;
}
