// Axes: from numbers to pixels and back, ticks, and numbers as text.
function scaleOf(limits, logarithmic, from, to) {
  const forward = logarithmic ? Math.log10 : (value) => value;
  const backward = logarithmic ? (value) => 10 ** value : (value) => value;
  const low = forward(limits[0]);
  const span = forward(limits[1]) - low || 1;
  return {
    pixel: (value) => from + ((forward(value) - low) / span) * (to - from),
    value: (pixel) => backward(low + ((pixel - from) / (to - from)) * span),
  };
}

// Fewer numbers than three hardly tell a scale: the next smaller step has more. Many degrees are told in parts of a turn.
function stepsOf(unit, rough, length) {
  const decade = 10 ** Math.floor(Math.log10(rough));
  const steps = unit === "deg" && length > 60 && length < 1080 ? [15, 30, 45, 90, 180, 360] : [0.1, 0.2, 0.25, 0.5, 1, 2, 2.5, 5, 10].map((part) => part * decade);
  const found = steps.findIndex((one) => one >= rough * 0.999);
  const first = found < 0 ? steps.length - 1 : found;
  return steps.slice(Math.max(0, first - 3), first + 1).reverse();
}

function linearTicks(low, high, most, unit) {
  let [values, step] = [[], 1];
  for (step of stepsOf(unit, (high - low) / Math.max(most, 2), high - low)) {
    values = [];
    for (let n = Math.ceil(low / step - 1e-9); n * step <= high + 1e-9 * step; n += 1) values.push(Number((n * step).toPrecision(10)));
    if (values.length >= 3) break;
  }
  const texts = values.map(plain);
  if (new Set(texts).size === texts.length && texts.some((text) => /10[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]/.test(text))) return values.map((value, n) => [value, texts[n]]);
  let decimals = 0;
  while (decimals < 15 && Math.abs(Number(step.toFixed(decimals)) - step) >= 1e-9 * step) decimals += 1;
  return values.map((value) => [value, value.toFixed(decimals).replace("-", "−")]);
}

function logTicks(low, high, most, unit) {
  const decades = Math.log10(high / low);
  if (decades < 0.7) return linearTicks(low, high, most, unit);
  const parts = decades < 2.2 ? [1, 2, 5] : [1];
  const every = Math.max(1, Math.ceil(decades / Math.max(most, 2)));
  const ticks = [];
  for (let n = Math.floor(Math.log10(low)); n <= Math.ceil(Math.log10(high)); n += 1) {
    for (const part of parts) {
      const value = part * 10 ** n;
      if (n % every === 0 && value >= low * 0.9999 && value <= high * 1.0001) ticks.push([value, plain(Number(value.toPrecision(6)))]);
    }
  }
  return ticks;
}

function ticksOf(axis, limits, most) {
  if (axis.ticks.length) return axis.ticks.filter(([value]) => value >= Math.min(...limits) && value <= Math.max(...limits));
  const [low, high] = [Math.min(...limits), Math.max(...limits)];
  return axis.log ? logTicks(low, high, most, axis.unit) : linearTicks(low, high, most, axis.unit);
}

function plain(value) {
  const size = Math.abs(value);
  if (value !== 0 && (size >= 1e6 || size < 1e-4)) {
    const [mantissa, exponent] = value.toExponential(4).replace(/\.?0+e/, "e").replace("e+", "e").split("e");
    const raised = exponent.replace(/./g, (sign) => "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"["-0123456789".indexOf(sign)]);
    return (mantissa === "1" ? "" : `${mantissa.replace("-", "−")} × `) + `10${raised}`;
  }
  return String(Number(value.toPrecision(10))).replace("-", "−");
}

function reading(value, unit) {
  if (value === null) return "none";
  return plain(Number(value.toPrecision(5))) + (unit ? ` ${unit}` : "");
}

function element(name, attributes, parent) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (parent) parent.appendChild(made);
  return made;
}

function node(name, properties, parent) {
  const made = Object.assign(document.createElement(name), properties);
  if (parent) parent.appendChild(made);
  return made;
}
