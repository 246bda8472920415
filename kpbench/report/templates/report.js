"use strict";
// A click on the name of a column sorts its table; a second click reverses the order. Rows without a value come last.
for (const button of document.querySelectorAll("th button")) {
  button.addEventListener("click", () => {
    const th = button.parentElement, table = th.closest("table"), body = table.tBodies[0];
    const falls = th.getAttribute("aria-sort") === "ascending";
    for (const other of th.parentElement.children) other.removeAttribute("aria-sort");
    th.setAttribute("aria-sort", falls ? "descending" : "ascending");
    const value = (row) => row.cells[th.cellIndex].dataset.v;
    const rows = [...body.rows].sort((a, b) => {
      const x = value(a), y = value(b);
      if (x === "" || y === "") return (x === "") - (y === "");
      const order = isNaN(x) || isNaN(y) ? x.localeCompare(y, "en", { numeric: true }) : x - y;
      return falls ? -order : order;
    });
    body.append(...rows);
  });
}
// A name in a legend switches its line off and on, in every chart of the page.
for (const button of document.querySelectorAll("[data-toggle]")) {
  button.addEventListener("click", () => {
    const name = button.dataset.toggle, on = button.getAttribute("aria-pressed") === "false";
    for (const other of document.querySelectorAll("[data-toggle]"))
      if (other.dataset.toggle === name) other.setAttribute("aria-pressed", on);
    for (const part of document.querySelectorAll("svg.chart [data-series]"))
      if (part.dataset.series === name) part.classList.toggle("off", !on);
  });
}
// Buttons zoom a chart, the pointer moves it, and the numbers at the pointer stand below it.
for (const readout of document.querySelectorAll(".readout")) {
  const figure = readout.parentElement, chart = figure.querySelector("svg.chart");
  const whole = chart.getAttribute("viewBox").split(" ").map(Number);
  let [x, y, width, height] = whole, held = null;
  const show = () => {
    x = Math.min(Math.max(x, 0), whole[2] - width);
    y = Math.min(Math.max(y, 0), whole[3] - height);
    chart.setAttribute("viewBox", [x, y, width, height].join(" "));
    chart.classList.toggle("zoomed", width < whole[2]);
  };
  for (const button of figure.querySelectorAll("[data-zoom]")) {
    button.addEventListener("click", () => {
      const size = Number(button.dataset.zoom) ? Math.min(whole[2], width * button.dataset.zoom) : whole[2];
      const factor = size / width;
      x += (width - size) / 2;
      y += (height - height * factor) / 2;
      [width, height] = [size, height * factor];
      show();
    });
  }
  chart.addEventListener("pointerdown", (event) => {
    if (width === whole[2]) return;
    held = [event.clientX, event.clientY];
    chart.setPointerCapture(event.pointerId);
  });
  chart.addEventListener("pointerup", () => { held = null; });
  chart.addEventListener("pointermove", (event) => {
    const box = chart.getBoundingClientRect();
    if (held) {
      x -= (event.clientX - held[0]) * width / box.width;
      y -= (event.clientY - held[1]) * height / box.height;
      held = [event.clientX, event.clientY];
      return show();
    }
    const at = x + (event.clientX - box.left) * width / box.width;
    const dots = [...chart.querySelectorAll("circle:not(.off)")];
    const away = (dot) => Math.abs(dot.cx.baseVal.value - at);
    const nearest = Math.min(...dots.map(away));
    for (const dot of dots) dot.classList.toggle("near", away(dot) - nearest < 0.5);
    readout.textContent = dots.filter((dot) => away(dot) - nearest < 0.5).map((dot) => dot.textContent).join("\n");
  });
}
