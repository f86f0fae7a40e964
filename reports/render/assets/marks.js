// Elements of plots: marks, swatches, ticks and numbers.

const RAISED = "⁰¹²³⁴⁵⁶⁷⁸⁹";
const OUTLINES = { // path data of marks in the square from −1 to 1
  s: "M-.9-.9H.9V.9H-.9Z", D: "M0-1.2L1.2 0 0 1.2-1.2 0Z", "^": "M0-1.1L1.05 .9H-1.05Z", v: "M0 1.1L1.05-.9H-1.05Z",
  "<": "M-1.1 0L.9-1.05V1.05Z", ">": "M1.1 0L-.9-1.05V1.05Z", x: "M-.9-.9L.9 .9M-.9 .9L.9-.9", "+": "M-1 0H1M0-1V1",
  P: "M-.4-1.1H.4V-.4H1.1V.4H.4V1.1H-.4V.4H-1.1V-.4H-.4Z", _: "M-1 0H1", "|": "M0-1V1",
  X: "M0-.5L.6-1.1 1.1-.6 .5 0 1.1 .6 .6 1.1 0 .5-.6 1.1-1.1 .6-.5 0-1.1-.6-.6-1.1Z",
  "*": "M0-1.3L.3-.4 1.25-.4 .5 .15 .8 1.05 0 .5-.8 1.05-.5 .15-1.25-.4-.3-.4Z",
};
const ROUND = "M-1 0A1 1 0 1 1 1 0A1 1 0 1 1-1 0Z";
const OPEN = new Set(["x", "+", "_", "|"]); // marks that are strokes

function svg(tag, attributes = {}, ...children) {
  const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  node.append(...children);
  return node;
}

/** Return the outline of a mark centred at a point, as path data. */
function mark(name, x, y, r) {
  const at = (t, v) => (v * r + t).toFixed(1);
  return (OUTLINES[name] ?? ROUND).replace(/([MLHVA])([^MLHVAZ]*)/g, (_, command, rest) => {
    const v = rest.match(/-?\d*\.?\d+/g).map(Number);
    if (command === "H") return `H${at(x, v[0])}`;
    if (command === "V") return `V${at(y, v[0])}`;
    if (command === "A") return `A${r} ${r} 0 1 1 ${at(x, v[5])} ${at(y, v[6])}`;
    return command + v.map((c, i) => at(i % 2 ? y : x, c)).join(" ");
  });
}

const ink = (t) => ({
  stroke: t.colour, fill: t.hollow || OPEN.has(t.marker) ? "none" : t.colour, "stroke-width": OPEN.has(t.marker) ? 1.2 : 1,
  ...(t.opacity < 1 ? { opacity: t.opacity } : {}),
});
const stroke = (t) => ({
  stroke: t.colour, fill: "none", "stroke-width": 1.35 * t.width, ...(t.dash ? { "stroke-dasharray": t.dash } : {}),
});

/** Draw a sample of a line and its marks for a legend. */
function swatch(look) {
  const line = look.dash === null || look.dash === undefined ? [] : [svg("path", { d: "M1 7H27", ...stroke(look) })];
  const dot = look.marker ? [svg("path", { d: mark(look.marker, 14, 7, 4), ...ink(look) })] : [];
  return svg("svg", { width: 28, height: 14, "aria-hidden": "true" }, ...line, ...dot);
}

const pen = document.createElement("canvas").getContext("2d");

/** Return the width of a text in px, in the font of a node. */
function breadth(text, node) {
  pen.font = getComputedStyle(node).font;
  return pen.measureText(text).width;
}

/** Abbreviate a text that is too wide in its middle, since names differ at their ends. */
function shortened(text, room, node) {
  let shown = text, letters = [...text];
  while (letters.length > 3 && breadth(shown, node) > room) {
    letters.splice(Math.floor((2 * letters.length) / 3), 1);
    const front = Math.ceil((2 * letters.length) / 3);
    shown = letters.slice(0, front).join("") + "…" + letters.slice(front).join("");
  }
  return shown;
}

const raised = (k) => (k < 0 ? "⁻" : "") + [...String(Math.abs(k))].map((d) => RAISED[d]).join("");

const decade = (v) => Math.floor(Math.log10(Math.abs(v)) + 1e-9);
const plain = (v) => v === 0 || (decade(v) >= -3 && decade(v) <= 4);

/** Format a number, with a power of ten if it is very small or large. */
function number(v, powered = !plain(v)) {
  if (v === 0) return "0";
  const size = decade(v);
  if (!powered) return String(Number(v.toPrecision(5)));
  const front = Number((v / 10 ** size).toPrecision(4));
  return (front === 1 ? "" : `${front}·`) + "10" + raised(size);
}

/** Return about `most` round values between two ends. */
function ticks([low, high], log, most) {
  if (log) {
    const a = Math.log10(low), b = Math.log10(high);
    const step = Math.ceil((b - a) / most);
    const every = (ks, subs) => ks.flatMap((k) => subs.map((s) => s * 10 ** k)).filter((v) => v >= low * (1 - 1e-9) && v <= high * (1 + 1e-9));
    const decades = [];
    for (let k = Math.floor(a); k <= Math.ceil(b); k++) if (k % step === 0) decades.push(k);
    const found = every(decades, b - a < 2.2 ? [1, 2, 5] : [1]);
    if (found.length > 1) return found;
  }
  const raw = (high - low) / most, size = 10 ** Math.floor(Math.log10(raw));
  const step = size * [1, 2, 5, 10].find((s) => s * size >= raw);
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high * (1 + 1e-12) + 1e-9 * step; k++) found.push(Number((k * step).toPrecision(12)));
  return found;
}

/** Return the visible ticks, either prescribed or about `most`, with labels in one format. */
function labelled({ view, log, ticks: set }, most) {
  const within = (v) => v >= view[0] && v <= view[1];
  if (set) return set.filter(([v]) => within(v));
  const found = ticks(view, log, most).filter(within);
  return found.map((v) => [v, number(v, !found.every(plain))]);
}
