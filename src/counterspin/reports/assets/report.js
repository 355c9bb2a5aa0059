// @ts-check
// The HTML report's script: the switch between light and dark, and plots that can be zoomed.
// Without it the report is complete; still pictures stand where the plots would be.
"use strict";

/**
 * Points of a plot, with bars from low to high; and a line of what the mouse is over.
 * @typedef {{x: number[], y: any[], low: any[] | null, high: any[] | null, colour: string,
 *   standsOut: boolean}} Points
 * @typedef {{label: string, colour: string, kind: string, shown?: HTMLElement,
 *   value: (u: any, at: number) => any[] | null}} Entry
 */

var counterspin = (() => {
  // Absent where no plot can be zoomed.
  const uPlot = /** @type {any} */ (globalThis).uPlot;
  const root = document.documentElement;
  const dark = matchMedia("(prefers-color-scheme: dark)");
  /** @type {(() => void)[]} */
  const redraws = [];

  // Light and dark; what was chosen is kept, where the browser keeps anything for this page

  const KEPT = "counterspin-theme";
  try {
    root.dataset.theme = localStorage.getItem(KEPT) ?? "";
  } catch { /* nothing is kept */ }
  const isDark = () => (root.dataset.theme ? root.dataset.theme === "dark" : dark.matches);
  const button = /** @type {HTMLElement} */ (document.getElementById("theme"));
  const showTheme = () => {
    button.textContent = isDark() ? "Light" : "Dark";
    button.setAttribute("aria-label", `Use ${isDark() ? "light" : "dark"} colours`);
    redraws.forEach((redraw) => redraw());
  };
  button.hidden = false;
  button.addEventListener("click", () => {
    root.dataset.theme = isDark() ? "light" : "dark";
    try {
      localStorage.setItem(KEPT, root.dataset.theme);
    } catch { /* nothing is kept */ }
    showTheme();
  });
  dark.addEventListener("change", showTheme);

  // Small tools

  /** @param {string} name */
  const colour = (name) => getComputedStyle(root).getPropertyValue(name).trim();

  /** @type {(name: string, attributes: Record<string, string>, ...children: (Node|string)[]) => HTMLElement} */
  const make = (name, attributes, ...children) => {
    const element = document.createElement(name);
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
    element.append(...children);
    return element;
  };

  /** @type {(value: number | null | undefined, digits: number) => string} */
  const format = (value, digits) =>
    value == null || !Number.isFinite(value)
      ? "–" : String(Number(value.toPrecision(digits))).replace(/^-/, "−");

  // An array comes as whole numbers and the size of one step.
  /** @param {any} packed */
  const read = (packed) =>
    packed && packed.values.map(/** @param {number | null} value */ (value) => (value === null ? null : value * packed.step));

  /** @type {(points: Points, low: number, high: number) => number[]} */
  const within = (points, low, high) =>
    points.x.flatMap((x, i) => (x >= low && x <= high && points.y[i] !== null ? [i] : []));

  // Tables that are wider than their box say so

  const moved = new ResizeObserver((boxes) => boxes.forEach(({ target }) =>
    target.classList.toggle("more", target.scrollWidth > target.clientWidth + 1)));

  // A plot: lines and bands are uPlot's, points and levels are drawn here, over them

  /** @param {any} plot */
  function parts(plot) {
    /** @type {any[][]} */
    const tables = [];
    /** @type {any[]} */
    const series = [{}];
    /** @type {any[]} */
    const bands = [];
    /** @type {Points[]} */
    const points = [];
    /** @type {Entry[]} */
    const legend = [];
    plot.series.forEach(/** @param {any} source */ (source) => {
      const name = source.colour;
      const one = {
        x: read(source.x), y: read(source.y), low: read(source.low), high: read(source.high),
      };
      /** @type {Entry} */
      const entry = { label: source.label, colour: name, kind: source.kind, value: () => null };
      const line = (/** @type {number} */ width, opacity = "") => ({
        stroke: () => colour(name) + opacity,
        width,
        spanGaps: false,
      });
      if (source.kind === "points") {
        const mine = { ...one, colour: name, standsOut: source.stands_out };
        points.push(mine);
        entry.value = (u, at) => nearest(u, mine, at);
      } else if (source.kind === "band") {
        const first = series.length;
        tables.push([one.x, one.low, one.high]);
        series.push(line(1, "a0"), line(1, "a0"));
        bands.push({ series: [first + 1, first], fill: () => `${colour(name)}66` });
        entry.value = (u) => [u.cursor.idxs[first], u.cursor.idxs[first + 1]]
          .map((i, k) => (i == null ? null : u.data[first + k][i]));
      } else {
        const at = series.length;
        tables.push([one.x, one.y]);
        series.push(line(1.5));
        entry.value = (u) => {
          const i = u.cursor.idxs[at];
          return i == null ? null : [u.data[at][i]];
        };
      }
      legend.push(entry);
    });
    // Points widen the axis, and must not be joined: two may share an x.
    const places = [...new Set(points.flatMap((one) => one.x))].sort((a, b) => a - b);
    if (places.length) tables.push([places]);
    // 2: a gap reaches to the neighbours that have a value (uPlot's JoinNullMode.Expand).
    const gaps = tables.map((table) => table.map(() => 2));
    const data = uPlot.join(tables, gaps);
    series.slice(1).forEach((one, i) => {
      const alone = between(data[i + 1]);
      one.points = { show: false, filter: () => alone, size: 4, fill: one.stroke };
    });
    return { data, series, bands, points, legend };
  }

  // Values between two gaps, which no line reaches; undefined is where other series have a value.
  /** @param {any[]} values */
  function between(values) {
    const places = values.flatMap((value, i) => (value === undefined ? [] : [i]));
    return places.filter((i, k) => values[i] !== null
      && (values[places[k - 1]] ?? null) === null && (values[places[k + 1]] ?? null) === null);
  }

  /** @type {(u: any, one: Points, at: number) => any[] | null} */
  function nearest(u, one, at) {
    const reach = 12;
    /** @type {number | null} */
    let best = null;
    let distance = reach;
    for (const i of within(one, u.posToVal(at - reach, "x"), u.posToVal(at + reach, "x"))) {
      const away = Math.abs(u.valToPos(one.x[i], "x") - at);
      if (away < distance) [best, distance] = [i, away];
    }
    return best === null ? null : [one.y[best]];
  }

  // The height follows what is seen of lines and ordinary points. What stands out widens it up to
  // three times; beyond that it would flatten all else, and is marked at the edge instead.
  /** @type {(u: any, low: number, high: number, points: Points[], levels: number[], log: boolean) => number[]} */
  function yRange(u, low, high, points, levels, log) {
    const { min, max } = u.scales.x;
    const [first, last] = u.series[0].idxs ?? [0, u.data[0].length - 1];
    /** @type {[number, number]} */
    const seen = [u.data[0][first] ?? min, u.data[0][last] ?? max];
    const values = (/** @type {Points[]} */ some) => some.flatMap((one) =>
      within(one, ...seen).flatMap((i) => [one.y[i], one.low?.[i] ?? one.y[i],
        one.high?.[i] ?? one.y[i]]));
    const out = points.filter((one) => one.standsOut);
    const plain = [low, high, ...values(points.filter((one) => !one.standsOut))]
      .filter(Number.isFinite);
    if (!plain.length) plain.push(...values(out));
    if (!plain.length) plain.push(...levels);
    if (!plain.length) return [0, 1];
    let [bottom, top] = [Math.min(...plain), Math.max(...plain)];
    if (log) return uPlot.rangeLog(bottom, top, 10, false);
    const height = top - bottom || Math.abs(top) || 1;
    for (const y of values(out)) {
      if (y > top && y < bottom + 3 * height) top = y;
      if (y < bottom && y > top - 3 * height) bottom = y;
    }
    const margin = 0.06 * (top - bottom || height);
    return [bottom - margin, top + margin];
  }

  /** @type {(u: any, levels: number[]) => void} */
  function drawLevels(u, levels) {
    const { ctx, bbox } = u;
    ctx.save();
    ctx.strokeStyle = colour("--muted");
    ctx.lineWidth = devicePixelRatio;
    ctx.setLineDash([5 * devicePixelRatio, 4 * devicePixelRatio]);
    for (const level of levels) {
      const y = u.valToPos(level, "y", true);
      if (y < bbox.top || y > bbox.top + bbox.height) continue;
      ctx.beginPath();
      ctx.moveTo(bbox.left, y);
      ctx.lineTo(bbox.left + bbox.width, y);
      ctx.stroke();
    }
    ctx.restore();
  }

  /** @type {(u: any, one: Points) => void} */
  function drawPoints(u, one) {
    const { ctx, bbox } = u;
    const size = 3.5 * devicePixelRatio;
    const bottom = bbox.top + bbox.height;
    ctx.save();
    ctx.fillStyle = ctx.strokeStyle = colour(one.colour);
    ctx.lineWidth = 1.25 * devicePixelRatio;
    for (const i of within(one, u.scales.x.min, u.scales.x.max)) {
      const x = u.valToPos(one.x[i], "x", true);
      const y = u.valToPos(one.y[i], "y", true);
      ctx.beginPath();
      if (one.low && one.high && one.low[i] !== null && one.high[i] !== null) {
        ctx.moveTo(x, Math.min(u.valToPos(one.low[i], "y", true), bottom));
        ctx.lineTo(x, Math.max(u.valToPos(one.high[i], "y", true), bbox.top));
        ctx.stroke();
        ctx.beginPath();
      }
      if (y < bbox.top || y > bottom) {
        const [edge, way] = y < bbox.top ? [bbox.top, 1] : [bottom, -1];
        ctx.moveTo(x, edge);
        ctx.lineTo(x - size, edge + 2 * way * size);
        ctx.lineTo(x + size, edge + 2 * way * size);
      } else {
        ctx.arc(x, y, size, 0, 2 * Math.PI);
      }
      ctx.fill();
    }
    ctx.restore();
  }

  /** @type {(label: string, size: number) => any} */
  function axis(label, size) {
    return {
      label,
      size,
      stroke: () => colour("--ink"),
      font: '12px system-ui, "Segoe UI", Roboto, sans-serif',
      labelFont: '12px system-ui, "Segoe UI", Roboto, sans-serif',
      labelSize: 20,
      grid: { stroke: () => colour("--grid"), width: 1 },
      ticks: { stroke: () => colour("--grid"), width: 1, size: 5 },
      /** @type {(u: any, splits: (number | null)[]) => string[]} */
      values: (u, splits) => splits.map((value) => (value == null ? "" : format(value, 6))),
    };
  }

  /** @param {any} figure */
  function zoomable(figure) {
    const plot = JSON.parse(figure.querySelector("script").textContent);
    const { data, series, bands, points, legend } = parts(plot);
    const title = figure.querySelector("figcaption").textContent;
    const canvas = make("div", { class: "canvas", role: "img", "aria-label": title });
    const readout = make("ul", { class: "readout" });
    const place = make("b", {});
    readout.append(make("li", {}, `${plot.x_label}: `, place));
    for (const entry of legend.filter((one) => one.label)) {
      const dots = entry.kind === "points" ? "dots" : "";
      entry.shown = make("b", {});
      const swatch = make("i", { class: dots, style: `background: var(${entry.colour})` });
      readout.append(make("li", {}, swatch, `${entry.label}: `, entry.shown));
    }
    const read = (/** @type {any} */ u) => {
      const { left, idx } = u.cursor;
      const over = left >= 0 && idx != null;
      place.textContent = over ? format(u.posToVal(left, "x"), 6) : "–";
      for (const entry of legend.filter((one) => one.label)) {
        const values = over ? entry.value(u, left) : null;
        /** @type {HTMLElement} */ (entry.shown).textContent = values ? values.map((one) => format(one, 4)).join(" to ") : "–";
      }
    };
    const box = make("div", { class: "live" });
    figure.append(box);
    figure.classList.add("zoomed");
    /** @type {(u: any, low: number, high: number) => number[]} */
    const range = (u, low, high) => yRange(u, low, high, points, plot.levels, plot.log_y);
    const chart = new uPlot(
      {
        width: figure.clientWidth,
        height: 300,
        legend: { show: false },
        cursor: {
          y: false,
          points: { show: false },
          drag: { x: true, y: false, dist: 4 },
          hover: { prox: 24, skip: [null, undefined] },
        },
        scales: {
          x: { time: false, distr: plot.log_x ? 3 : 1 },
          y: { distr: plot.log_y ? 3 : 1, range },
        },
        axes: [axis(plot.x_label, 34), axis(plot.y_label, 58)],
        series,
        bands,
        hooks: {
          setCursor: [read],
          drawClear: [(/** @type {any} */ u) => drawLevels(u, plot.levels)],
          draw: [(/** @type {any} */ u) => points.forEach((one) => drawPoints(u, one))],
        },
      },
      data,
      canvas,
    );
    figure.chart = chart;

    // What a mouse does by dragging, keys and fingers do with these
    const whole = [data[0][0], data[0].at(-1)];
    /** @type {(shift: number, factor: number) => void} */
    const see = (shift, factor) => {
      const { min, max } = chart.scales.x;
      const half = Math.min(0.5 * (max - min) * factor, 0.5 * (whole[1] - whole[0]));
      const middle = 0.5 * (min + max) + shift * (max - min);
      const centre = Math.min(Math.max(middle, whole[0] + half), whole[1] - half);
      chart.setScale("x", { min: centre - half, max: centre + half });
    };
    /** @type {(sign: string, words: string, action: () => void) => HTMLElement} */
    const tool = (sign, words, action) => {
      const one = make("button", { type: "button", "aria-label": words, title: words }, sign);
      one.addEventListener("click", action);
      return one;
    };
    box.append(
      make("div", { class: "tools" },
        tool("+", "Zoom in", () => see(0, 0.5)),
        tool("−", "Zoom out", () => see(0, 2)),
        tool("‹", "Move left", () => see(-0.25, 1)),
        tool("›", "Move right", () => see(0.25, 1)),
        tool("Whole", "Show the whole", () => chart.setScale("x", { min: whole[0], max: whole[1] })),
        make("p", {}, "Drag to zoom in, double-click to zoom out.")),
      canvas,
      readout,
    );
    read(chart);
    redraws.push(() => chart.redraw(false));
    new ResizeObserver(() => {
      const width = box.clientWidth;
      if (width && width !== chart.width) chart.setSize({ width, height: 300 });
    }).observe(box);
  }

  // Whatever a page shows later is given to this, too.
  /** @param {ParentNode} part */
  function draw(part) {
    part.querySelectorAll(".scroll").forEach((box) => moved.observe(box));
    if (uPlot) part.querySelectorAll("figure.zoomable").forEach(zoomable);
  }

  draw(document);
  showTheme();
  return { draw, axis, colour, redraws };
})();
