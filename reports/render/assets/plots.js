// Plots: the panels of a figure and a legend whose keys act on the whole page.

/** Build a legend; keys of solvers are buttons. */
function legend({ title, keys }) {
  const key = (k) => (k.s >= 0 ? solverButton(k.s, k.label, k) : make("span", { class: "key" }, swatch(k), k.label));
  return make("div", { class: "legend" }, ...(title && keys.length ? [make("span", {}, title)] : []), ...keys.map(key));
}

function plot(box, panels) {
  const grid = make("div", { class: "panels", style: `--columns: ${panels[0].columns}` });
  const groups = new Map();
  const made = panels.map((content, i) => {
    const group = groups.get(content.share) ?? groups.set(content.share, []).get(content.share);
    const one = chart(grid.appendChild(make("div", { class: "panel", "data-id": `plot-${box.dataset.plot}-${i}` })), content, group, box.dataset.name);
    group.push(one);
    grid.lastElementChild.append(legend(content.own));
    return one;
  });
  if (panels[0].heading) box.append(make("p", { class: "heading" }, panels[0].heading));
  box.append(grid, legend(panels[0].common));
  const view = () => made.forEach((one) => one.draw());
  views.push(view);
  new ResizeObserver(view).observe(grid);
}

function plots() {
  document.querySelectorAll(".plot").forEach((box) => plot(box, data.plots[Number(box.dataset.plot)]));
}
