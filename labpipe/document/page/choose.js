// Choosing from a panel: a click (or Enter on a reading) takes the nearest value or gives it back; the line to copy stands below.
function choose(figure, panel, place) {
  const { pick } = panel.spec;
  if (!pick || !place || place.one.kind !== "line") return;
  figure.chosen = figure.chosen || [];
  const near = figure.chosen.findIndex((value) => Math.abs(panel.scale.x.pixel(value) - panel.scale.x.pixel(place.x)) < 4);
  if (near >= 0) figure.chosen.splice(near, 1);
  else figure.chosen.push(place.x);
  figure.chosen.sort((a, b) => a - b);
  if (!figure.choice) {
    figure.choice = node("output", { className: "choice" }, figure.live);
    figure.choice.setAttribute("aria-live", "polite");
  }
  const unit = panel.spec.x.unit ? ` ${panel.spec.x.unit}` : "";
  const values = figure.chosen.map((value) => `${Number(value.toPrecision(6))}${unit}`);
  figure.choice.textContent = values.length ? `${pick}: [${values.join(", ")}]` : "";
  figure.draw();
}

function drawChosen(figure, panel) {
  const { box, scale } = panel;
  for (const value of panel.spec.pick ? figure.chosen || [] : []) {
    const x = scale.x.pixel(value);
    if (x >= box.left && x <= box.right) element("path", { class: "chosen", d: `M${x} ${box.top}V${box.bottom}` }, panel.svg);
  }
}
