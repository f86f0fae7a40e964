// Tables: sorting, filtering, hiding and paging.

const PAGE = 50; // rows of a table on one page, equal to FIRST in html_page.py
const NUMBER = /(\b\d[\d.]*e-\d+\b)/;
const LEFTWARDS = /([\u0590-\u08ff\ufb1d-\ufdff\ufe70-\ufefc]+)/;
const TEXT = 0, VALUE = 1, KIND = 2, SYMBOL = 3, AFTER = 4, TITLE = 5, RUNS = 6;

const field = (cell, i) => (typeof cell === "string" ? (i === TEXT ? cell : undefined) : cell[i]) ?? null;
const textOf = (cell) => [SYMBOL, TEXT, AFTER].map((i) => field(cell, i) ?? "").join(" ");

/** Allow line breaks after slashes and none within numbers, like html_page.breakable. */
function breakable(text) {
  const split = (parts, pattern, wrap) => parts.flatMap((part) =>
    typeof part === "string" ? part.split(pattern).map((t, i) => (i % 2 ? wrap(t) : t)) : [part]);
  const lines = split([text], /(\/)/, (t) => t).flatMap((t) => (t === "/" ? ["/", make("wbr")] : [t]));
  const kept = split(lines, NUMBER, (t) => make("span", { class: "nb" }, t));
  return split(kept, LEFTWARDS, (t) => make("bdi", {}, t));
}

/** Build a table cell, like the macro `entry` of page.html.j2. */
function entry(cell, isName) {
  const text = field(cell, TEXT), kind = field(cell, KIND) ?? "", links = field(cell, RUNS);
  const shown = kind === "void" ? [make("s", {}, text)] : breakable(text);
  const td = make("td", { class: (isName ? "name " : "") + ([...text].length > 56 ? "long " : "") + kind });
  if (field(cell, TITLE)) td.title = field(cell, TITLE);
  if (field(cell, SYMBOL)) td.append(make("span", { class: "s" }, field(cell, SYMBOL)), " ");
  if (links) {
    const target = "#run-" + encodeURIComponent(runs.id[links[0]]);
    td.append(make("a", { href: target, "data-runs": links.join(",") }, ...shown));
  } else td.append(...shown);
  if (field(cell, AFTER)) td.append(" ", make("small", {}, field(cell, AFTER)));
  return td;
}

/** Yield the indices in a packed list of measurements: first, count, first, count … */
function* unpacked(packed) {
  for (let i = 0; i < packed.length; i += 2) {
    for (let k = 0; k < packed[i + 1]; k++) yield packed[i] + k;
  }
}

const some = (packed, test) => {
  for (const run of unpacked(packed)) if (test(run)) return true;
  return false;
};

function table(figure, content) {
  const body = figure.querySelector("tbody"), pager = figure.querySelector(".pager");
  const heads = [...figure.querySelectorAll("th")];
  const own = figure.querySelector(".filter");
  const columns = content.columns;
  const place = (test) => columns.findIndex(test);
  const solver = place((c) => c === "solver"), tol = place((c) => c === "tol");
  const name = place((c) => c === "case" || c === "physical case");
  const column = columns.map((c, i) => (i >= content.words ? solverOf.get(c) : undefined));
  const total = content.rows.filter((row) => field(row[0], KIND) === "total");
  const rows = content.rows.filter((row) => field(row[0], KIND) !== "total");
  const texts = new Map();
  let sorted = rows, wanted = [], start = 0, size = PAGE, drawn = false;

  const whole = (row) => {
    if (!texts.has(row)) texts.set(row, row.map(textOf).join(" ").toLowerCase());
    return texts.get(row);
  };
  const open = (i) => !hidden.has(column[i]);
  const fits = (row) => {
    if (solver >= 0 && hidden.has(solverOf.get(field(row[solver], TEXT)))) return false;
    if (tol >= 0 && asked.tol && field(row[tol], TEXT) !== asked.tol) return false;
    if (name >= 0 && asked.words.length && !holds(field(row[name], TEXT), asked.words)) return false;
    if (asked.verdict) {
      const linked = row.filter((cell, i) => open(i) && field(cell, RUNS));
      if (linked.length && !linked.some((cell) => some(field(cell, RUNS), hasVerdict))) return false;
    }
    return wanted.every((word) => whole(row).includes(word));
  };

  function pages(count) {
    const last = Math.min(start + size, count);
    const all = content.rows.length - total.length;
    const of = count < all ? `${count} rows (of ${all})` : `${count} rows`;
    const part = count > size ? `Rows ${start + 1}–${last} of ${of}` : count < all ? of : "";
    const go = (label, text, move, able) => {
      const button = make("button", { type: "button", "aria-label": label, ...(able ? {} : { disabled: "" }) }, text);
      button.addEventListener("click", () => {
        move();
        draw();
        pager.querySelector(`[aria-label="${label}"]:enabled`)?.focus() ?? pager.querySelector("button:enabled")?.focus();
      });
      return button;
    };
    pager.replaceChildren(make("span", { role: "status" }, part));
    if (count > PAGE) {
      if (size === PAGE) {
        pager.append(
          go("previous rows", "‹ previous", () => { start -= PAGE; }, start > 0),
          go("next rows", "next ›", () => { start += PAGE; }, last < count),
          go("all rows", `show all ${count}`, () => { start = 0; size = Infinity; }, true));
      } else pager.append(go("fewer rows", `show ${PAGE}`, () => { size = PAGE; }, true));
    }
  }

  function draw() {
    drawn = true;
    const found = sorted.filter(fits);
    if (start >= found.length) start = 0;
    heads.forEach((head, i) => { head.hidden = !open(i); });
    figure.hidden = content.solver !== "" && hidden.has(solverOf.get(content.solver));
    const line = (row, kind) => {
      const tr = make("tr", kind);
      row.forEach((cell, i) => { if (open(i)) tr.append(entry(cell, i < content.words)); });
      return tr;
    };
    body.replaceChildren(
      ...found.slice(start, start + size).map((row) => line(row, {})),
      ...total.map((row) => line(row, { class: "total" })));
    pages(found.length);
    roving(body);
    measure(figure.querySelector(".scroll"));
  }

  heads.forEach((head, i) => head.firstElementChild.addEventListener("click", () => {
    const down = head.getAttribute("aria-sort") === "ascending";
    heads.forEach((h) => h.removeAttribute("aria-sort"));
    head.setAttribute("aria-sort", down ? "descending" : "ascending");
    const text = (row) => field(row[i], TEXT);
    sorted = [...rows].sort((a, b) => {
      const p = field(a[i], VALUE), q = field(b[i], VALUE);
      if (p === null && q === null) return (down ? -1 : 1) * collator.compare(text(a), text(b));
      if (p === null || q === null) return p === null ? 1 : -1;
      return down ? q - p : p - q;
    });
    start = 0;
    draw();
  }));
  if (own) {
    own.hidden = false;
    own.firstElementChild.addEventListener("input", (event) => { wanted = words(event.target.value); start = 0; draw(); });
  }
  const untouched = () => !hidden.size && !asked.words.length && !asked.tol && !asked.verdict;
  views.push(() => { if (drawn || !untouched()) draw(); });
  if (rows.length > PAGE) pages(rows.length);
  roving(body);
}

const collator = new Intl.Collator("en", { numeric: true });

/** Show a hint when a table or a printed figure is wider than its box. */
function measure(box) {
  const wide = box.scrollWidth > box.clientWidth + 1;
  box.classList.toggle("wide", wide);
  box.previousElementSibling.hidden = !wide;
}

/** Keep one link of a table in the tab order; arrow keys reach the others. */
function roving(body) {
  body.querySelectorAll("a").forEach((a, i) => { a.tabIndex = i ? -1 : 0; });
}

function moved(event) {
  const step = { ArrowLeft: [0, -1], ArrowRight: [0, 1], ArrowUp: [-1, 0], ArrowDown: [1, 0] }[event.key];
  const from = event.target.closest("td");
  if (!step || !from || event.altKey || event.ctrlKey || event.metaKey) return;
  const lines = [...from.parentElement.parentElement.rows];
  let i = lines.indexOf(from.parentElement), j = from.cellIndex;
  for (;;) {
    i += step[0];
    j += step[1];
    const cell = lines[i]?.cells[j];
    if (!cell) break;
    const to = cell.querySelector("a");
    if (to) {
      event.target.tabIndex = -1;
      to.tabIndex = 0;
      to.focus();
      break;
    }
  }
  event.preventDefault();
}

function tables() {
  document.querySelectorAll("figure.table").forEach((figure, i) => table(figure, data.tables[i]));
  const watch = new ResizeObserver((boxes) => boxes.forEach((box) => measure(box.target)));
  document.querySelectorAll(".scroll").forEach((box) => watch.observe(box));
  document.querySelectorAll("tbody").forEach((body) => body.addEventListener("keydown", moved));
}
