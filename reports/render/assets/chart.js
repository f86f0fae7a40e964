// One panel of a plot: the curves of a printed figure, with zoom and tooltips.

const NEAR = 24; // px, largest distance of the pointer from a selected point
const APART = 70; // px between the marks of a line with sparse marks
const LETTER = 6.2; // px, approximate width of a letter
const MARGIN = 66; // px, smallest width left of the axis
const MOST = 0.4; // largest share of the width for names left of the axis
const PER_INCH = 104; // px per inch of the printed figure

/** Draw one panel with axes, traces and selection; `linked` panels share the x axis. */
function chart(box, content, linked, name) {
  const axes = { x: { ...content.x, view: content.x.limits }, y: { ...content.y, view: content.y.limits } };
  const small = content.y.ticks?.length === 0;
  const drawing = svg("svg", { tabindex: 0, role: "group", "aria-label": `${name}${content.title ? `, ${content.title}` : ""}: ${axes.y.label} against ${axes.x.label || "the same"}` });
  const tip = make("div", { class: "tip", role: "status", hidden: "" });
  const bar = make("div", { class: "bar" });
  const below = content.x.label ? 42 : content.x.numbered ? 24 : small ? 3 : 10; // px, for ticks and label
  const height = small ? 14 * content.traces.length + 6 + below : Math.min(Math.max(content.height * PER_INCH, 230), 460);
  const top = content.title ? 24 : 8;
  const titled = !small && axes.y.label ? 22 : 0; // px, for the label along the axis
  let points = [], at = -1, scale = null, band = null;
  const up = { x: (v) => (axes.x.log ? Math.log10(v) : v), y: (v) => (axes.y.log ? Math.log10(v) : v) };
  const down = { x: (v) => (axes.x.log ? 10 ** v : v), y: (v) => (axes.y.log ? 10 ** v : v) };

  const shows = (t, i) => {
    if (t.s >= 0 && hidden.has(t.s)) return false;
    const packed = t.runs?.length > 1 ? t.runs[i] : t.runs?.[0];
    return !packed?.length || some(packed, seen);
  };
  const inside = (axis, v) => v !== null && (!axes[axis].log || v > 0);

  function all(axis) { // all visible values along an axis
    const found = [];
    for (const t of content.traces) {
      if (t.kind === "line") t[axis].forEach((v, i) => { if (inside(axis, v) && shows(t, i)) found.push(v); });
      if (t.kind === "area" && shows(t, 0)) t.outlines.forEach((o) => o.forEach((v, i) => { if ((i % 2 ? "y" : "x") === axis && inside(axis, v)) found.push(v); }));
    }
    return found;
  }
  function fitted(axis) {
    const values = all(axis);
    if (!values.length) return axes[axis].log ? [0.1, 10] : [0, 1];
    let a = Infinity, b = -Infinity;
    for (const v of values) { a = Math.min(a, up[axis](v)); b = Math.max(b, up[axis](v)); }
    const pad = 0.05 * (b - a) || 0.5 * Math.abs(b) || 0.5;
    return [down[axis](a - pad), down[axis](b + pad)];
  }
  function home(axis) {
    const same = axes[axis].log === content[axis].log;
    axes[axis].view = same ? content[axis].limits : fitted(axis);
  }
  function share() {
    for (const one of linked) one.follow(axes.x);
  }
  const follow = (x) => { Object.assign(axes.x, { log: x.log, view: x.view }); draw(); };

  function zoom(factor, fx = 0.5, fy = 0.5) {
    for (const [axis, f] of [["x", fx], ["y", fy]]) {
      const [a, b] = axes[axis].view.map(up[axis]);
      const middle = a + f * (b - a);
      axes[axis].view = [a, b].map((v) => down[axis](middle + (v - middle) * factor));
    }
    share();
  }
  function pan(dx, dy) {
    for (const [axis, d] of [["x", dx], ["y", dy]]) {
      const [a, b] = axes[axis].view.map(up[axis]);
      axes[axis].view = [a, b].map((v) => down[axis](v + d * (b - a)));
    }
    share();
  }
  const reset = () => { home("x"); home("y"); share(); };

  function traced(t) { // path data and the points of one line
    let path = "", marks = "", pen = false, marked = [-Infinity, 0];
    t.x.forEach((x, i) => {
      const y = t.y[i];
      if (!inside("x", x) || !inside("y", y)) { pen = false; return; }
      if (!shows(t, i)) return;
      const p = scale.x(x), q = scale.y(y);
      path += !pen ? `M${p.toFixed(1)} ${q.toFixed(1)}` : t.step ? `H${p.toFixed(1)}V${q.toFixed(1)}` : `L${p.toFixed(1)} ${q.toFixed(1)}`;
      pen = true;
      if (p < scale.left - 1 || p > scale.right + 1 || q < scale.top - 1 || q > scale.bottom + 1) return;
      if (t.marker && !(t.few && Math.hypot(p - marked[0], q - marked[1]) < APART)) {
        marks += mark(t.marker, p, q, 0.62 * t.size);
        marked = [p, q];
      }
      if (t.marker !== "_" && t.marker !== "|") points.push({ p, q, t, i });
    });
    return [path, marks];
  }
  function* drawn(t) {
    if (t.s >= 0 && hidden.has(t.s)) return;
    const own = t.s >= 0 ? { "data-solver": t.s, class: "trace" } : { class: "trace" };
    if (t.kind === "line") {
      const [path, marks] = traced(t);
      if (t.dash !== null && path) yield svg("path", { d: path, ...stroke(t), ...own });
      if (marks) yield svg("path", { d: marks, ...ink(t), ...own });
    } else if (t.kind === "segments") {
      const kept = t.ends.filter((e, i) => shows(t, i) && e.every((v, k) => inside(k % 2 ? "y" : "x", v)));
      const path = kept.map(([a, b, c, d]) => `M${scale.x(a).toFixed(1)} ${scale.y(b).toFixed(1)}L${scale.x(c).toFixed(1)} ${scale.y(d).toFixed(1)}`).join("");
      if (path) yield svg("path", { d: path, ...stroke(t), ...own });
    } else {
      const ring = (o) => "M" + o.reduce((s, v, i) => s + (i % 2 ? `${scale.y(v).toFixed(1)}L` : `${scale.x(v).toFixed(1)} `), "").slice(0, -1) + "Z";
      const path = t.outlines.filter((o) => o.every((v, k) => inside(k % 2 ? "y" : "x", v))).map(ring).join("");
      if (path) yield svg("path", { d: path, fill: t.colour, "fill-opacity": t.opacity, ...own });
    }
  }

  const aside = () => labelled(axes.y, Math.max(2, Math.floor((height - below - top) / 45)));
  function margin() { // width of the texts left of the axis
    const texts = small ? [axes.y.label] : aside().map(([, text]) => text);
    return Math.max(MARGIN, titled + 8 + Math.max(0, ...texts.map((text) => breadth(text, drawing))));
  }

  function frame(W, H) {
    const parts = [];
    const grid = { stroke: "var(--rule)", "stroke-width": 0.6 };
    const label = (text, attributes) => parts.push(svg("text", attributes, text));
    const beside = (text, y) => { // left of the axis
      const shown = shortened(text, scale.left - 8 - titled, drawing);
      label(shown, { x: scale.left - 6, y, "text-anchor": "end", "dominant-baseline": "central" });
      if (shown !== text) parts.at(-1).append(svg("title", {}, text));
    };
    const above = (text, y) => { // above or below the axes: in their middle, but within the drawing
      const larger = 1.06, room = W / larger; // these letters are larger than the measured ones
      const shown = shortened(text, room, drawing), half = (Math.min(breadth(shown, drawing), room) * larger) / 2;
      label(shown, { x: Math.min(Math.max((scale.left + scale.right) / 2, half), W - half), y, "text-anchor": "middle", class: "axis" });
      if (shown !== text) parts.at(-1).append(svg("title", {}, text));
    };
    for (const [v, text] of labelled(axes.x, Math.max(3, Math.floor((scale.right - scale.left) / 80)))) {
      const p = scale.x(v).toFixed(1);
      if (!small) parts.push(svg("path", { d: `M${p} ${scale.top}V${scale.bottom}`, ...grid }));
      if (axes.x.numbered) label(text, { x: p, y: scale.bottom + 17, "text-anchor": "middle" });
    }
    for (const [v, text] of aside()) {
      parts.push(svg("path", { d: `M${scale.left} ${scale.y(v).toFixed(1)}H${scale.right}`, ...grid }));
      beside(text, scale.y(v).toFixed(1));
    }
    parts.push(svg("path", { d: small ? `M${scale.left} ${scale.bottom}H${scale.right}` : `M${scale.left} ${scale.top}V${scale.bottom}H${scale.right}`, fill: "none", stroke: "currentColor", "stroke-width": 0.9 }));
    above(axes.x.label, H - 6);
    const middle = (scale.top + scale.bottom) / 2;
    if (small) beside(axes.y.label, middle);
    else label(axes.y.label, { transform: `translate(13 ${middle}) rotate(-90)`, "text-anchor": "middle", class: "axis" });
    if (content.title) above(content.title, 14);
    return parts;
  }
  function* lines() {
    for (const r of content.rules) {
      const v = scale[r.axis](r.at);
      if (!inside(r.axis, r.at)) continue;
      yield svg("path", { d: r.axis === "y" ? `M${scale.left} ${v}H${scale.right}` : `M${v} ${scale.top}V${scale.bottom}`, ...stroke(r) });
    }
  }
  function* remarks() {
    for (const t of content.texts) {
      const place = (axis, k) => (t.inside[k] ? (axis === "x" ? scale.left + t.place[0] * (scale.right - scale.left) : scale.bottom - t.place[1] * (scale.bottom - scale.top)) : inside(axis, t.place[k]) ? scale[axis](t.place[k]) : NaN);
      const x = place("x", 0), y = place("y", 1);
      if (!(x >= scale.left - 1 && x <= scale.right + 1 && y >= scale.top - 1 && y <= scale.bottom + 1)) continue;
      const end = t.align[0] === "right" || x + LETTER * t.text.length > scale.right;
      const shift = t.align[1] === "top" ? 15 : t.align[1] === "bottom" || x > scale.right - 20 ? -4 : 0;
      const gap = t.inside[0] ? 3 : 8;
      yield svg("text", { x: x + (end ? -gap : gap), y: y + shift, "text-anchor": end ? "end" : "start", ...(shift ? {} : { "dominant-baseline": "central" }), class: "remark" }, t.text);
    }
  }

  function draw() {
    const W = drawing.clientWidth || box.clientWidth, H = height;
    if (!W) return;
    const left = Math.min(Math.max(...linked.map((one) => one.margin())), MOST * W);
    scale = { left, right: W - 14, top, bottom: H - below };
    const line = (axis, from, to) => {
      const [a, b] = axes[axis].view.map(up[axis]);
      return (v) => from + ((up[axis](v) - a) / (b - a)) * (to - from);
    };
    scale.x = line("x", scale.left, scale.right);
    scale.y = line("y", scale.bottom, scale.top);
    [points, at] = [[], -1];
    tip.hidden = true;
    const clip = `${box.dataset.id}-clip`;
    const room = svg("clipPath", { id: clip }, svg("rect", { x: scale.left - 5, y: scale.top - 5, width: scale.right - scale.left + 10, height: scale.bottom - scale.top + 10 }));
    const curves = svg("g", { "clip-path": `url(#${clip})` }, ...lines(), ...content.traces.flatMap((t) => [...drawn(t)]));
    const empty = curves.querySelector(".trace") || small ? [] : [svg("text", { x: (scale.left + scale.right) / 2, y: H / 2, "text-anchor": "middle" }, "nothing here: hidden, filtered out or outside the axes")];
    drawing.setAttribute("height", H);
    drawing.replaceChildren(room, ...frame(W, H), curves, ...remarks(), ...empty, svg("g", { class: "over" }));
    for (const axis of ["x", "y"]) bar.querySelector(`.${axis}`)?.setAttribute("aria-pressed", String(axes[axis].log));
  }

  function select(i) {
    at = i;
    const over = drawing.querySelector(".over");
    tip.hidden = i < 0;
    over.replaceChildren();
    if (i < 0) return;
    const { p, q, t, i: k } = points[i];
    over.append(svg("circle", { cx: p, cy: q, r: 7, fill: "none", stroke: "currentColor" }));
    const packed = t.runs?.length > 1 ? t.runs[k] : t.runs?.[0];
    const run = packed?.[0];
    const said = [t.s >= 0 ? data.solvers[t.s].names[0] : ""];
    if (run !== undefined) said.push(`${columnValue("case", run)}, tol ${columnValue("tol", run)}, ${columnValue("status", run)}`);
    said.push(`${axes.x.label || linked.map((one) => one.label).find(Boolean) || "x"}: ${number(t.x[k])}`, `${axes.y.label}: ${number(t.y[k])}`);
    if (run !== undefined) said.push(`run ${runs.id[run]}`);
    tip.replaceChildren(...said.filter(Boolean).map((s) => make("div", {}, s)));
    const above = q > (scale.top + scale.bottom) / 2 ? tip.offsetHeight + 28 : 0;
    const from = drawing.getBoundingClientRect().top - box.getBoundingClientRect().top;
    tip.style.left = `${Math.max(0, Math.min(p + 14, box.clientWidth - tip.offsetWidth - 2))}px`;
    tip.style.top = `${from + q + 14 - above}px`;
  }
  function nearest(x, y) {
    let best = -1, least = NEAR ** 2;
    points.forEach(({ p, q }, i) => {
      const d = (p - x) ** 2 + (q - y) ** 2;
      if (d < least) [best, least] = [i, d];
    });
    return best;
  }
  function visitPoint() {
    const { t, i } = points[at];
    const packed = t.runs?.length > 1 ? t.runs[i] : t.runs?.[0];
    if (packed?.length) visit(packed[0], [...unpacked(packed)]);
  }
  function step(along, across) {
    if (!points.length) return;
    if (at < 0) return select(0);
    if (along) return select((at + along + points.length) % points.length);
    const order = [...new Set(points.map((one) => one.t))];
    const next = order[(order.indexOf(points[at].t) + across + order.length) % order.length];
    let best = -1;
    points.forEach((one, i) => { if (one.t === next && (best < 0 || Math.abs(one.p - points[at].p) < Math.abs(points[best].p - points[at].p))) best = i; });
    select(best);
  }

  const place = (event) => {
    const r = drawing.getBoundingClientRect();
    return [event.clientX - r.left, event.clientY - r.top];
  };
  drawing.addEventListener("pointerdown", (event) => {
    if (event.pointerType === "touch" || event.button) return;
    band = place(event);
    drawing.setPointerCapture(event.pointerId);
  });
  drawing.addEventListener("pointermove", (event) => {
    const [x, y] = place(event);
    if (!band) return select(nearest(x, y));
    const rect = { x: Math.min(x, band[0]), y: Math.min(y, band[1]), width: Math.abs(x - band[0]), height: Math.abs(y - band[1]) };
    tip.hidden = true;
    drawing.querySelector(".over").replaceChildren(svg("rect", { ...rect, class: "band" }));
  });
  drawing.addEventListener("pointerup", (event) => {
    const [x, y] = place(event), from = band;
    band = null;
    if (from && Math.abs(x - from[0]) > 6 && Math.abs(y - from[1]) > 6) {
      const back = (axis, v, a, b) => { const [l, h] = axes[axis].view.map(up[axis]); return down[axis](l + ((v - a) / (b - a)) * (h - l)); };
      const ends = (axis, u, v, a, b) => [back(axis, u, a, b), back(axis, v, a, b)].sort((m, n) => m - n);
      axes.x.view = ends("x", x, from[0], scale.left, scale.right);
      axes.y.view = ends("y", y, from[1], scale.bottom, scale.top);
      return share();
    }
    select(nearest(x, y));
    if (at >= 0 && event.pointerType !== "touch") visitPoint();
  });
  drawing.addEventListener("pointerleave", () => { if (!band && document.activeElement !== drawing) select(-1); });
  drawing.addEventListener("dblclick", reset);
  drawing.addEventListener("wheel", (event) => {
    if (!event.ctrlKey) return;
    event.preventDefault();
    const [x, y] = place(event);
    zoom(event.deltaY > 0 ? 1.25 : 0.8, (x - scale.left) / (scale.right - scale.left), (scale.bottom - y) / (scale.bottom - scale.top));
  }, { passive: false });
  const keys = {
    ArrowLeft: () => step(-1, 0), ArrowRight: () => step(1, 0), ArrowUp: () => step(0, -1), ArrowDown: () => step(0, 1),
    "+": () => zoom(0.7), "=": () => zoom(0.7), "-": () => zoom(1 / 0.7), 0: reset,
    Enter: () => { if (at >= 0) visitPoint(); }, " ": () => { if (at >= 0) visitPoint(); }, Escape: () => select(-1),
  };
  const pans = { ArrowLeft: [-0.2, 0], ArrowRight: [0.2, 0], ArrowUp: [0, 0.2], ArrowDown: [0, -0.2] };
  drawing.addEventListener("keydown", (event) => {
    if (event.altKey || event.ctrlKey || event.metaKey) return;
    if (event.shiftKey && pans[event.key]) pan(...pans[event.key]);
    else if (keys[event.key]) keys[event.key]();
    else return;
    event.preventDefault();
  });
  drawing.addEventListener("blur", () => select(-1));

  const button = (text, label, act, className = "") => {
    const b = make("button", { type: "button", "aria-label": label, title: label, class: className }, text);
    b.addEventListener("click", act);
    bar.append(b);
  };
  const logged = (axis) => () => {
    axes[axis].log = !axes[axis].log;
    home(axis);
    share();
  };
  if (!small) {
    const positive = (axis) => !axes[axis].ticks && content.traces.some((t) => t.kind === "line" && t[axis].some((v) => v > 0));
    if (positive("x")) button("log x", "logarithmic horizontal axis", logged("x"), "x");
    if (positive("y")) button("log y", "logarithmic vertical axis", logged("y"), "y");
    button("+", "zoom in", () => zoom(0.7));
    button("−", "zoom out", () => zoom(1 / 0.7));
    button("⟲", "whole plot", reset);
    box.append(bar);
  }
  box.append(drawing, tip);
  return { draw, follow, margin, label: content.x.label };
}
