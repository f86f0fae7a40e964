// The measurement behind a number: all fields of its journal line, and the command that repeats it.

let details = null;
const SHORT = ["case", "solver", "tol", "repeat", "status", "claimed", "message", "iterations",
  "prepare_seconds", "solve_seconds", "total_seconds", "primal", "dual", "complementarity", "gap", "objective"];

/** Unpack all fields of all measurements; called when the first one is shown. */
function unpack() {
  const bytes = Uint8Array.from(atob(byId("details").textContent), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).json();
}

/** Return one journal line, field by field. */
async function line(run) {
  details ??= unpack();
  const columns = Object.entries(await details);
  const pick = (column) => (Array.isArray(column) ? column[run] : column.values[column.at[run]]);
  return Object.fromEntries(columns.map(([name, column]) => [name, pick(column)]));
}

/** Return the quoted path of the result folder, or DIR if the page is not in one. */
function folder() {
  const parts = decodeURIComponent(location.pathname).split("/");
  if (location.protocol !== "file:" || parts.at(-2) !== "report") return "DIR";
  return quoted(parts.slice(0, -2).join("/") || "/");
}

/** Quote a word for a shell. */
const quoted = (word) => (/^[\w@%+=:,./-]+$/.test(word) ? word : `'${word.replaceAll("'", "'\\''")}'`);

function pairs(fields) {
  const rows = fields.map(([name, value]) => {
    const text = typeof value === "string" ? value : JSON.stringify(value);
    return make("tr", {}, make("th", { scope: "row" }, name), make("td", {}, ...breakable(text)));
  });
  return make("table", { class: "fields" }, make("tbody", {}, ...rows));
}

async function fill(dialog, run, others) {
  const record = await line(run);
  const button = (text, to) => {
    const b = make("button", { type: "button", ...(to === undefined ? { disabled: "" } : {}) }, text);
    if (to !== undefined) b.addEventListener("click", () => visit(to, others));
    return b;
  };
  const at = others.indexOf(run);
  const close = make("button", { type: "button", class: "close" }, "close");
  close.addEventListener("click", () => dialog.close());
  const command = `mortarbench replay ${folder()} ${quoted([record.session, record.run_id].filter(Boolean).join("-"))}`;
  const stored = ["vectors", "fields"].filter((name) => record[name]).map((name) =>
    make("li", {}, `${name}: `, make("a", { href: `../vectors/${encodeURIComponent(record[name])}.npz` }, `vectors/${record[name]}.npz`)));
  const rest = Object.entries(record).filter(([name]) => !SHORT.includes(name));
  dialog.replaceChildren(
    make("div", { class: "bar" },
      ...(others.length > 1
        ? [button("‹", others[at - 1]), make("span", {}, `${at + 1} of ${others.length}`), button("›", others[at + 1])]
        : []),
      close),
    make("h2", { id: "run-title" }, `Run ${runs.id[run]}`),
    make("p", {}, "Repeat this measurement: ", make("code", {}, command)),
    make("ul", {}, ...stored),
    pairs(SHORT.filter((name) => name in record).map((name) => [name, record[name]])),
    make("details", {}, make("summary", {}, "other fields of the journal line"), pairs(rest)));
}

/** Show one of the runs behind a number. */
async function visit(run, others) {
  const dialog = byId("run");
  await fill(dialog, run, others);
  history.replaceState(null, "", "#run-" + encodeURIComponent(runs.id[run]));
  if (!dialog.open) dialog.showModal();
  dialog.scrollTop = 0;
}

/** Show the run named in the address. */
function arrive() {
  if (!location.hash.startsWith("#run-")) return;
  const run = runs.id.indexOf(decodeURIComponent(location.hash.slice(5)));
  if (run >= 0) visit(run, [run]);
}

function panel() {
  const dialog = byId("run");
  if (!dialog) return;
  document.addEventListener("click", (event) => {
    const a = event.target.closest("a[data-runs]");
    if (!a || event.ctrlKey || event.metaKey || event.shiftKey) return;
    event.preventDefault();
    const others = [...unpacked(a.dataset.runs.split(",").map(Number))];
    visit(others[0], others);
  });
  dialog.addEventListener("click", (event) => { if (event.target === dialog) dialog.close(); });
  dialog.addEventListener("close", () => history.replaceState(null, "", location.pathname + location.search));
  addEventListener("hashchange", arrive);
  arrive();
}

themes();
tools();
tables();
plots();
panel();
if (byId("state")) redraw();
