"use strict";
// Shared by all parts of the page: the data, the state of the filters, and DOM nodes.

const data = JSON.parse(document.getElementById("data").textContent);
const runs = data.runs;
const hidden = new Set(); // positions of solvers
const asked = { words: [], tol: "", verdict: "" };
const views = []; // functions that redraw one part each

const byId = (id) => document.getElementById(id);
const solverOf = new Map(data.solvers.flatMap((s, i) => s.names.map((name) => [name, i])));
const words = (text) => text.toLowerCase().split(/\s+/).filter(Boolean);
const holds = (text, wanted) => {
  const lower = text.toLowerCase();
  return wanted.every((word) => lower.includes(word));
};
const columnValue = (column, run) => runs[column].values[runs[column].at[run]];

/** Create an element with attributes; children are nodes or text, never markup. */
function make(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  node.append(...children);
  return node;
}

/** Return whether a measurement has the selected verdict. */
const hasVerdict = (run) =>
  asked.verdict === "" ||
  (asked.verdict === "not verified" ? columnValue("status", run) !== "verified" : columnValue("status", run) === asked.verdict);

/** Return whether a measurement passes all filters. */
const seen = (run) =>
  !hidden.has(solverOf.get(columnValue("solver", run))) &&
  (asked.tol === "" || columnValue("tol", run) === asked.tol) &&
  hasVerdict(run) &&
  holds(columnValue("case", run), asked.words);

function redraw() {
  for (const view of views) view();
}

function toggle(solver) {
  if (!hidden.delete(solver)) hidden.add(solver);
  redraw();
}

/** Switch between light, dark and system colours; store the choice if the browser permits. */
function themes() {
  const button = byId("theme");
  const names = ["system", "light", "dark"];
  const kept = { get: () => null, set: () => {} };
  try {
    const store = window.localStorage;
    kept.get = () => store.getItem("theme");
    kept.set = (name) => store.setItem("theme", name);
  } catch { /* browsers may deny storage to local files */ }
  const apply = (name) => {
    document.documentElement.style.colorScheme = name === "system" ? "light dark" : name;
    button.textContent = `colours: ${name}`;
    button.dataset.theme = name;
  };
  button.hidden = false;
  button.addEventListener("click", () => {
    const next = names[(names.indexOf(button.dataset.theme) + 1) % names.length];
    kept.set(next);
    apply(next);
  });
  apply(names.includes(kept.get()) ? kept.get() : "system");
  let before = "";
  addEventListener("beforeprint", () => { before = button.dataset.theme; apply("light"); });
  addEventListener("afterprint", () => apply(before));
}

/** Create a button that shows and hides one solver in all tables and plots. */
function solverButton(solver, text, look) {
  const button = make("button", { type: "button", class: "key" }, swatch(look), text || "(no name)");
  const view = () => button.setAttribute("aria-pressed", String(!hidden.has(solver)));
  button.addEventListener("click", () => toggle(solver));
  views.push(view);
  view();
  return button;
}

/** Set up the bar that filters all tables and plots. */
function tools() {
  const bar = byId("tools");
  if (!bar) return;
  const solvers = byId("solvers");
  data.solvers.forEach((s, i) => solvers.append(solverButton(i, s.names[0], s)));
  if (data.solvers.length > 2) {
    const several = (text, act) => {
      const button = make("button", { type: "button" }, text);
      button.addEventListener("click", () => { act(); redraw(); });
      solvers.append(button);
    };
    several("all", () => hidden.clear());
    several("none", () => data.solvers.forEach((_, i) => hidden.add(i)));
  }
  const option = (text) => make("option", { value: text }, text);
  byId("tol").append(...runs.tol.values.map(option));
  const bad = runs.status.values.some((v) => v !== "verified" && v !== "declined");
  byId("verdict").append(...runs.status.values.map(option), ...(bad ? [option("not verified")] : []));
  for (const id of ["tol", "verdict"]) {
    byId(id).parentElement.hidden = runs[id === "tol" ? id : "status"].values.length < 2;
    byId(id).addEventListener("change", (event) => { asked[id] = event.target.value; redraw(); });
  }
  byId("words").addEventListener("input", (event) => { asked.words = words(event.target.value); redraw(); });
  byId("reset").addEventListener("click", () => {
    hidden.clear();
    Object.assign(asked, { words: [], tol: "", verdict: "" });
    for (const id of ["words", "tol", "verdict"]) byId(id).value = "";
    redraw();
  });
  views.push(() => {
    const shown = data.solvers.length - hidden.size;
    byId("state").textContent = [
      `${shown} of ${data.solvers.length} solvers`,
      asked.words.length ? `cases with “${asked.words.join(" ")}”` : "all cases",
      ...(asked.tol ? [`tol ${asked.tol}`] : []),
      ...(asked.verdict ? [asked.verdict] : []),
    ].join(" · ");
  });
  bar.hidden = false;
}
