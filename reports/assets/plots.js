// Plots: the panels of a figure and one legend, whose keys act on all of the page.

function plot(box, panels) {
  const grid = make("div", { class: "panels", style: `--columns: ${panels[0].columns}` });
  const groups = new Map();
  const made = panels.map((content, i) => {
    const group = groups.get(content.share) ?? groups.set(content.share, []).get(content.share);
    const one = chart(grid.appendChild(make("div", { class: "panel", "data-id": `plot-${box.dataset.plot}-${i}` })), content, group, box.dataset.name);
    group.push(one);
    return one;
  });
  const legend = make("div", { class: "legend" });
  for (const key of panels[0].keys ?? []) {
    legend.append(key.s >= 0 ? solverButton(key.s, key.label, key) : make("span", { class: "key" }, swatch(key), key.label));
  }
  box.append(grid, legend);
  const view = () => made.forEach((one) => one.draw());
  views.push(view);
  new ResizeObserver(view).observe(grid);
}

function plots() {
  document.querySelectorAll(".plot").forEach((box) => plot(box, data.plots[Number(box.dataset.plot)]));
}
