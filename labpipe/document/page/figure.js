// A figure: its panels side by side as far as the page is wide, its legend, its buttons. Each takes its numbers from the page.
const NARROWEST = 165;
const AT_ONCE = 8;
const PICK_HINT = " Click a point, or Enter on a reading, to choose it.";
const HINT = "Drag a box to zoom; click, then wheel; arrow keys read values; 0 shows all. Touch a curve to read it.";

function start(holder, number) {
  const spec = JSON.parse(holder.querySelector("script").textContent);
  const figure = { spec, hidden: new Set(), place: null, panels: [] };
  figure.live = node("div", { className: "live" });
  controls(figure, holder);
  figure.grid = node("div", { className: "panels" }, figure.live);
  spec.panels.forEach((panel, place) => figure.panels.push(makePanel(figure, panel, `live-${number}-${place}`)));
  figure.box = node("output", { className: "reading", hidden: true }, figure.live);
  figure.box.setAttribute("aria-live", "polite");
  figure.draw = () => draw(figure);
  holder.insertBefore(figure.live, holder.firstChild);
  holder.classList.add("alive");
  for (const panel of figure.panels) follow(figure, panel);
  new ResizeObserver(() => { if (Math.abs(figure.live.clientWidth - figure.room) > 1) draw(figure); }).observe(figure.live);
  draw(figure);
  return figure;
}

function makePanel(figure, spec, id) {
  const svg = element("svg", { tabindex: 0, role: "application", width: "100%", "aria-roledescription": "chart" });
  const label = [spec.title, `${spec.y.title || "matrix"} over ${spec.x.title || "its columns"}`].filter(Boolean).join(": ");
  svg.setAttribute("aria-label", `${label}. Arrow keys read values, plus and minus zoom, 0 shows all.`);
  figure.grid.appendChild(svg);
  for (const one of spec.series) Object.assign(one, { x: figure.spec.numbers[one.x], y: figure.spec.numbers[one.y] });
  for (const one of spec.series) if (one.low !== undefined) Object.assign(one, { low: figure.spec.numbers[one.low], high: figure.spec.numbers[one.high] });
  const panel = { spec, svg, id, limits: { x: [...spec.x.limits], y: [...spec.y.limits] } };
  panel.shown = () => spec.series.filter((one) => !figure.hidden.has(listed(one)));
  panel.pixels = (one, values) => pixelsOf(panel, one, values);
  panel.orderly = spec.series.filter((one) => one.kind === "line").every((one) => rising(one.x));
  return panel;
}

function rising(values) {
  const there = values.filter((value) => value !== null);
  return there.every((value, n) => n === 0 || value >= there[n - 1]);
}

function pixelsOf(panel, one, values) {
  const { x, y } = panel.scale;
  const { log } = panel.spec.y;
  const floor = panel.box.bottom + 5000;
  const points = values.map((value, n) => {
    if (value === null || one.x[n] === null || (panel.spec.x.log && !(one.x[n] > 0))) return null;
    const down = log && !(value > 0) ? floor : y.pixel(value);
    return [Math.round(100 * x.pixel(one.x[n])) / 100, Math.round(100 * Math.min(Math.max(down, -floor), floor)) / 100];
  });
  if (values === one.y) one.pixels = points;
  return points;
}

function draw(figure, width = figure.live.clientWidth) {
  const { spec } = figure;
  figure.width = width;
  figure.room = figure.live.clientWidth;
  const columns = Math.max(1, Math.min(spec.columns, Math.floor(figure.width / NARROWEST)));
  const wide = Math.floor((figure.width - 8 * (columns - 1)) / columns);
  figure.grid.style.gridTemplateColumns = `repeat(${columns}, minmax(0, 1fr))`;
  const last = (place) => columns !== spec.columns || spec.columns > 1 || !figure.panels.slice(place + 1).some((other) => other.spec.x.group === figure.panels[place].spec.x.group);
  figure.panels.forEach((panel, place) => {
    panel.lowest = last(place);
    panel.names = namesOf(panel, wide);
    panel.height = heightOf(figure, panel, wide) + (panel.lowest ? panel.names.height : 0);
    panel.margins = marginsOf(panel, panel.lowest);
  });
  const left = Math.max(...figure.panels.map((panel) => panel.margins.left));
  for (const panel of figure.panels) {
    drawPanel(panel, wide, left, panel.lowest);
    drawChosen(figure, panel);
  }
  figure.box.hidden = true;
}

function heightOf(figure, panel, width) {
  if (cellsOf(panel)) return Math.min(40 * Math.max(cellsOf(panel).values.length, 3) + 60, width);
  if (panel.spec.equal) return width;
  const inches = figure.spec.columns > 1 ? figure.spec.height / figure.spec.rows : figure.spec.height * panel.spec.share;
  return Math.round(Math.max(inches * 96 * Math.min(1, 0.55 + width / 1400), 110)) + (panel.lowest ? 20 : 0);
}

function controls(figure, holder) {
  const bar = node("div", { className: "controls" }, figure.live);
  const caption = holder.querySelector("figcaption b")?.textContent || "Figure";
  const first = () => figure.panels[0];
  const button = (text, label, act) => {
    const made = node("button", { type: "button", textContent: text, title: label, onclick: act }, bar);
    made.setAttribute("aria-label", `${label}, ${caption}`);
  };
  const names = [...new Set(figure.spec.panels.flatMap((panel) => panel.series.filter((one) => one.name).map(listed)))];
  const legend = node("div", { className: "legend" }, bar);
  legend.setAttribute("role", "group");
  legend.setAttribute("aria-label", `Series of ${caption}`);
  if (names.length) names.forEach((name) => legendButton(figure, legend, name));
  button("+", "Zoom in", () => zoomAbout(figure, first(), "x", 0.5, 0.7));
  button("−", "Zoom out", () => zoomAbout(figure, first(), "x", 0.5, 1 / 0.7));
  button("All", "Show all", () => showAll(figure));
  bar.title = HINT + (figure.spec.panels.some((panel) => panel.pick) ? PICK_HINT : "");
}

// Several series may share an entry of the legend.
function listed(one) {
  return one.entry || one.name;
}

function legendButton(figure, legend, name) {
  const members = figure.spec.panels.flatMap((panel) => panel.series).filter((each) => listed(each) === name);
  // Dots and line of one entry are shown on each other.
  const one = { ...members[0], ...members.find((each) => each.marker), line: (members.find((each) => each.line) ?? members[0]).line };
  const made = node("button", { type: "button", className: "entry" }, legend);
  made.setAttribute("aria-pressed", "true");
  const swatch = element("svg", { width: 22, height: 10, "aria-hidden": "true", style: `--own: ${inkOf(one.colour)}` }, made);
  if (one.line) element("path", { class: "curve", d: "M1 5H21", "stroke-dasharray": DASHES[one.line] || "", "stroke-width": 2 }, swatch);
  if (one.marker && one.hollow) element("circle", { class: "hollow", cx: 11, cy: 5, r: 3.5 }, swatch);
  else if (one.marker) drawDots({ ...one, size: 5 }, [[11, 5]], swatch);
  if (!one.line && !one.marker) element("rect", { class: "shade", x: 1, y: 1, width: 20, height: 8, style: `fill-opacity: ${Math.max(one.opacity ?? 0.2, 0.2)}` }, swatch);
  node("span", { textContent: name }, made);
  made.onclick = () => {
    const hide = !figure.hidden.has(name);
    figure.hidden[hide ? "add" : "delete"](name);
    made.setAttribute("aria-pressed", String(!hide));
    draw(figure);
  };
}

// The first figures at once; the others one by one, so that a long report answers meanwhile. Paper has all, as wide as it is.
const PAPER = 680;
const holders = [...document.querySelectorAll("figure.numbers")];
const figures = holders.slice(0, AT_ONCE).map(start);
function startNext() {
  if (figures.length < holders.length) figures.push(start(holders[figures.length], figures.length));
  return figures.length < holders.length;
}
function startRest() {
  if (startNext()) setTimeout(startRest);
}
setTimeout(startRest);
addEventListener("beforeprint", () => {
  while (startNext());
  for (const figure of figures) draw(figure, PAPER);
});
addEventListener("afterprint", () => { for (const figure of figures) draw(figure); });
