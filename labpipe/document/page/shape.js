// Mode shapes on the structure: a drag or the arrow keys turn it, it sways in the chosen mode. Numbers as in shape_drawing.py.
const PERIOD = 1600;
const TURN = 0.01;
const MOST_DOTS = 400;
const EYES = { Oblique: [-0.9, 0.5], Front: [0, 0], Side: [Math.PI / 2, 0], Top: [0, Math.PI / 2] };

function startShape(holder) {
  const spec = JSON.parse(holder.querySelector("script").textContent);
  const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
  const shape = { spec, mode: 0, eye: [...EYES.Oblique], phase: 0, playing: !still, seen: true };
  shape.live = node("div", { className: "live" });
  shapeControls(shape, holder);
  shape.svg = element("svg", { tabindex: 0, role: "application", viewBox: viewOf(spec), width: "100%", "aria-roledescription": "structure", class: "shape" }, shape.live);
  shape.svg.setAttribute("aria-label", "Structure in a mode. Arrow keys turn it, space stops or starts the motion.");
  shape.rest = element("path", { class: "rest" }, shape.svg);
  shape.moved = element("path", { class: "moved" }, shape.svg);
  const dots = spec.names.length <= MOST_DOTS ? spec.names : [];
  shape.dots = dots.map((name) => {
    const dot = element("circle", { class: "point", r: 0.006 }, shape.svg);
    element("title", {}, dot).textContent = name;
    return dot;
  });
  holder.insertBefore(shape.live, holder.firstChild);
  holder.classList.add("alive");
  turning(shape);
  new IntersectionObserver((entries) => { shape.seen = entries.at(-1).isIntersecting; sway(shape); }).observe(shape.svg);
  drawShape(shape);
}

// Room for the structure however it is turned, and for its motion.
function viewOf(spec) {
  const half = Math.max(...spec.positions.map((point) => Math.hypot(...point))) + spec.reach;
  return `${-half} ${-half} ${2 * half} ${2 * half}`;
}

function shapeControls(shape, holder) {
  const bar = node("div", { className: "controls" }, shape.live);
  const caption = holder.querySelector("figcaption b")?.textContent || "Figure";
  const modes = node("div", { className: "legend" }, bar);
  modes.setAttribute("role", "group");
  modes.setAttribute("aria-label", `Modes of ${caption}`);
  const entries = shape.spec.modes.map((mode, place) => {
    const made = node("button", { type: "button", className: "mode", textContent: mode.title }, modes);
    made.setAttribute("aria-pressed", String(place === 0));
    made.onclick = () => {
      shape.mode = place;
      entries.forEach((entry, n) => entry.setAttribute("aria-pressed", String(n === place)));
      drawShape(shape);
    };
    return made;
  });
  shape.play = node("button", { type: "button", textContent: shape.playing ? "Stop" : "Sway" }, bar);
  shape.play.onclick = () => playOrStop(shape);
  for (const [name, eye] of Object.entries(EYES)) {
    node("button", { type: "button", textContent: name, onclick: () => { shape.eye = [...eye]; drawShape(shape); } }, bar);
  }
}

function playOrStop(shape) {
  shape.playing = !shape.playing;
  shape.play.textContent = shape.playing ? "Stop" : "Sway";
  sway(shape);
}

function sway(shape) {
  if (shape.running || !shape.playing || !shape.seen) return;
  shape.running = true;
  const from = performance.now() - (shape.phase / (2 * Math.PI)) * PERIOD;
  const next = (now) => {
    shape.running = shape.playing && shape.seen;
    if (!shape.running) return;
    shape.phase = (2 * Math.PI * (now - from)) / PERIOD;
    drawShape(shape);
    requestAnimationFrame(next);
  };
  requestAnimationFrame(next);
}

function turning(shape) {
  let last = null;
  shape.svg.onpointerdown = (event) => { last = [event.clientX, event.clientY]; shape.svg.setPointerCapture(event.pointerId); };
  shape.svg.onpointerup = () => { last = null; };
  shape.svg.onpointermove = (event) => {
    if (!last) return;
    turn(shape, TURN * (event.clientX - last[0]), TURN * (event.clientY - last[1]));
    last = [event.clientX, event.clientY];
  };
  const keys = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] };
  shape.svg.onkeydown = (event) => {
    if (event.key === " ") playOrStop(shape);
    else if (keys[event.key]) turn(shape, ...keys[event.key]);
    else return;
    event.preventDefault();
  };
}

function turn(shape, across, up) {
  shape.eye = [shape.eye[0] - across, Math.min(Math.max(shape.eye[1] + up, -Math.PI / 2), Math.PI / 2)];
  drawShape(shape);
}

// As the eye sees a point: turned about z by the azimuth, raised by the elevation; downwards is positive on a screen.
function projectedPoint(eye, [x, y, z]) {
  const [c, s] = [Math.cos(eye[0]), Math.sin(eye[0])];
  const away = c * y - s * x;
  return [c * x + s * y, -(Math.cos(eye[1]) * z + Math.sin(eye[1]) * away)];
}

function drawShape(shape) {
  const { spec, eye } = shape;
  const mode = spec.modes[shape.mode];
  const [c, s] = [Math.cos(shape.phase), Math.sin(shape.phase)];
  const rest = spec.positions.map((point) => projectedPoint(eye, point));
  const moved = spec.positions.map((point, n) => projectedPoint(eye, point.map((value, k) => value + c * mode.real[n][k] - s * mode.imaginary[n][k])));
  const path = (points) => spec.lines.map(([a, b]) => `M${points[a].map(short)}L${points[b].map(short)}`).join("");
  shape.rest.setAttribute("d", path(rest));
  shape.moved.setAttribute("d", path(moved));
  shape.dots.forEach((dot, n) => { dot.setAttribute("cx", short(moved[n][0])); dot.setAttribute("cy", short(moved[n][1])); });
}

function short(value) {
  return Math.round(1e4 * value) / 1e4;
}

for (const holder of document.querySelectorAll("figure.shapes")) startShape(holder);
