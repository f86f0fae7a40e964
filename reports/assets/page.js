"use strict";
// Hide and show a solver in all figures and tables.
for (const box of document.querySelectorAll("#solvers input")) {
  box.addEventListener("change", () => {
    for (const part of document.querySelectorAll(`.solver${box.value}`))
      part.classList.toggle("hidden", !box.checked);
  });
}
// Sort a table by the column whose heading is clicked; numbers by value.
const units = { s: 1, ms: 1e-3, "µs": 1e-6 };
function value(cell) {
  const text = cell ? cell.firstChild?.textContent ?? "" : "";
  const found = text.match(/^\(?(-?[\d.]+(?:e-?\d+)?)\s*(\S*)/);
  return found ? Number(found[1]) * (units[found[2]] ?? 1) : text;
}
for (const button of document.querySelectorAll("th button")) {
  button.addEventListener("click", () => {
    const head = button.parentElement, body = head.closest("table").tBodies[0];
    const down = head.getAttribute("aria-sort") === "ascending";
    for (const other of head.parentElement.children) other.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", down ? "descending" : "ascending");
    const order = (a, b) => {
      const [x, y] = [a, b].map((row) => value(row.cells[head.cellIndex]));
      const numbers = typeof x === "number" && typeof y === "number";
      if (typeof x !== typeof y) return typeof x === "number" ? -1 : 1;
      return (numbers ? x - y : x.localeCompare(y)) * (down ? -1 : 1);
    };
    body.append(...[...body.rows].sort(order));
  });
}
