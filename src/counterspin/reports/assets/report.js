// @ts-check
// Script of the HTML report: light and dark colours, tabs, and zoomable plots.
// Without the script the report is complete, with static pictures.
"use strict";

/**
 * Points of a plot, with error bars from low to high; and an entry of the readout.
 * @typedef {{x: number[], y: any[], low: any[] | null, high: any[] | null, colour: string,
 *   standsOut: boolean}} Points
 * @typedef {{label: string, colour: string, kind: string, shown?: HTMLElement,
 *   value: (u: any, at: number) => any[] | null}} Entry
 */

var counterspin = (() => {
  // Undefined if no plot is zoomable.
  const uPlot = /** @type {any} */ (globalThis).uPlot;
  const root = document.documentElement;
  const dark = matchMedia("(prefers-color-scheme: dark)");
  /** @type {(() => void)[]} */
  const redraws = [];

  // Light and dark colours; the choice is stored if the browser allows it

  const THEME_KEY = "counterspin-theme";
  try {
    root.dataset.theme = localStorage.getItem(THEME_KEY) ?? "";
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
      localStorage.setItem(THEME_KEY, root.dataset.theme);
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

  // Arrays are quantised to integers.
  /** @param {any} quantised */
  const unpack = (quantised) =>
    quantised && quantised.values.map(/** @param {number | null} value */ (value) => (value === null ? null : value * quantised.step));

  /** @type {(points: Points, low: number, high: number) => number[]} */
  const indicesWithin = (points, low, high) =>
    points.x.flatMap((x, index) => (x >= low && x <= high && points.y[index] !== null ? [index] : []));

  // Mark tables that are wider than their box

  const overflowObserver = new ResizeObserver((boxes) => boxes.forEach(({ target }) =>
    target.classList.toggle("more", target.scrollWidth > target.clientWidth + 1)));

  // Chapters as tabs on a screen, and consecutive on paper

  const TAB_KEY = "counterspin-tab";

  /** @param {HTMLElement} box with a section for each chapter */
  function makeTabs(box) {
    const sections = /** @type {HTMLElement[]} */ ([...box.children]);
    const bar = make("div", { class: "tablist", role: "tablist", "aria-label": "Chapters" });
    /** @type {(chosen: number, focus?: boolean) => void} */
    const openTab = (chosenIndex, focus = false) => buttons.forEach((tab, index) => {
      const isSelected = index === chosenIndex;
      tab.setAttribute("aria-selected", String(isSelected));
      tab.tabIndex = isSelected ? 0 : -1;
      sections[index].classList.toggle("open", isSelected);
      if (isSelected && focus) tab.focus();
    });
    const buttons = sections.map((section, index) => {
      const heading = /** @type {HTMLElement} */ (section.querySelector("h2"));
      section.id = `${heading.id}-panel`;
      const tab = make("button", { type: "button", role: "tab", id: `${heading.id}-tab`, "aria-controls": section.id });
      tab.append(...heading.cloneNode(true).childNodes);
      section.setAttribute("role", "tabpanel");
      section.setAttribute("aria-labelledby", tab.id);
      tab.addEventListener("click", () => {
        openTab(index);
        try {
          sessionStorage.setItem(TAB_KEY, heading.id);
        } catch { /* nothing is kept */ }
      });
      return tab;
    });
    bar.addEventListener("keydown", (event) => {
      const currentIndex = buttons.findIndex((tab) => tab.tabIndex === 0);
      /** @type {Record<string, number>} */
      const targets = { ArrowLeft: currentIndex - 1, ArrowRight: currentIndex + 1, Home: 0, End: buttons.length - 1 };
      if (!(event.key in targets)) return;
      event.preventDefault();
      openTab((targets[event.key] + buttons.length) % buttons.length, true);
    });
    bar.append(...buttons);
    box.prepend(bar);
    box.classList.add("tabbed");
    const follow = () => {
      const target = document.getElementById(location.hash.slice(1));
      const index = sections.findIndex((section) => target && section.contains(target));
      if (index < 0 || !target) return;
      openTab(index);
      target.scrollIntoView();
    };
    let storedTab = null;
    try {
      storedTab = sessionStorage.getItem(TAB_KEY);
    } catch { /* nothing is kept */ }
    openTab(Math.max(sections.findIndex((section) => section.id === `${storedTab}-panel`), 0));
    addEventListener("hashchange", follow);
    follow();
  }

  // Copying and saving of tables and figures

  /** @type {(name: string, type: string, content: BlobPart) => void} */
  function saveAs(name, type, content) {
    const link = make("a", { download: name, href: URL.createObjectURL(new Blob([content], { type })) });
    link.click();
    setTimeout(() => URL.revokeObjectURL(/** @type {HTMLAnchorElement} */ (link).href), 10000);
  }

  /** @param {string} text */
  const fileName = (text) => text.replace(/[^A-Za-z0-9]+/g, "-").replace(/^-|-$/g, "").toLowerCase();

  /** @type {(words: string, of: string, work: (button: HTMLElement) => void | Promise<void>) => HTMLElement} */
  function toolButton(label, subject, action) {
    const button = make("button", { type: "button", "aria-label": `${label}: ${subject}` }, label);
    const failure = make("span", { role: "alert" });
    button.addEventListener("click", async () => {
      failure.remove();
      try {
        await action(button);
      } catch (error) {
        failure.textContent = label === "Copy"
          ? "Not copied: the browser refuses access to the clipboard. Select the table and copy it, or save it as CSV."
          : `Not saved as ${label}: ${/** @type {Error} */ (error).message || "the browser cannot draw the figure"}. Reload the page and try again.`;
        button.after(failure);
      }
    });
    return button;
  }

  /** @param {HTMLTableElement} table */
  const cellsOf = (table) => [...table.rows].map((row) =>
    [...row.cells].filter((cell) => !cell.classList.contains("control"))
      .map((cell) => (cell.textContent ?? "").replace(/[\u00a0\u202f]/g, " ").trim()));

  /** @param {string} text */
  async function copy(text) {
    if (navigator.clipboard) return navigator.clipboard.writeText(text);
    const area = /** @type {HTMLTextAreaElement} */ (make("textarea", {}, text));
    document.body.append(area);
    area.select();
    const isCopied = document.execCommand("copy");
    area.remove();
    if (!isCopied) throw new Error("copying is refused");
  }

  /** @param {HTMLElement} box */
  function tableTools(box) {
    const table = /** @type {HTMLTableElement} */ (box.querySelector("table"));
    const label = (box.getAttribute("aria-label") ?? "").replace(/^Table: /, "");
    const quote = (/** @type {string} */ cell) => {
      const plainText = cell.replace(/−/g, "-");
      return /[",\n]/.test(plainText) ? `"${plainText.replaceAll('"', '""')}"` : plainText;
    };
    box.before(make("div", { class: "tools save" },
      toolButton("Copy", label, async (button) => {
        await copy(cellsOf(table).map((row) => row.join("\t")).join("\n"));
        button.textContent = "Copied";
        setTimeout(() => { button.textContent = "Copy"; }, 2000);
      }),
      toolButton("CSV", label, () => saveAs(`${fileName(label)}.csv`, "text/csv;charset=utf-8",
        `\ufeff${cellsOf(table).map((row) => row.map(quote).join(",")).join("\r\n")}\r\n`))));
  }

  /** @param {HTMLElement} figure */
  function figureTools(figure) {
    const caption = /** @type {HTMLElement} */ (figure.querySelector("figcaption"));
    const title = caption.textContent ?? "figure";
    const picture = /** @type {any} */ (figure.querySelector(".still"));
    const serializePicture = async () => {
      const text = picture.querySelector("svg")?.outerHTML ?? await picture.fetchPicture();
      const svg = /** @type {Element} */ (new DOMParser().parseFromString(text, "text/html").querySelector("svg"));
      const [, , width, height] = (svg.getAttribute("viewBox") ?? "0 0 800 500").split(/[\s,]+/).map(Number);
      svg.setAttribute("width", String(width));
      svg.setAttribute("height", String(height));
      svg.setAttribute("style", `background: ${colour("--ground")}`);
      const svgText = new XMLSerializer().serializeToString(svg)
        .replace(/var\((--[\w-]+)[^)]*\)/g, (_, name) => colour(name));
      return { whole: svgText, width, height };
    };
    caption.after(make("div", { class: "tools save" },
      toolButton("SVG", title, async () => saveAs(`${fileName(title)}.svg`, "image/svg+xml", (await serializePicture()).whole)),
      toolButton("PNG", title, async () => {
        const { whole: svgText, width, height } = await serializePicture();
        const image = new Image();
        image.src = `data:image/svg+xml;charset=utf-8,${encodeURIComponent(svgText)}`;
        await image.decode();
        const canvas = /** @type {HTMLCanvasElement} */ (make("canvas", {}));
        [canvas.width, canvas.height] = [2 * width, 2 * height];
        const context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
        context.fillStyle = colour("--ground");
        context.fillRect(0, 0, canvas.width, canvas.height);
        context.drawImage(image, 0, 0, canvas.width, canvas.height);
        canvas.toBlob((blob) => { if (blob) saveAs(`${fileName(title)}.png`, "image/png", blob); });
      })));
  }

  // Plots: uPlot draws lines and bands; points and levels are drawn here on top

  /** @param {any} plot */
  function plotParts(plot) {
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
      const arrays = {
        x: unpack(source.x), y: unpack(source.y), low: unpack(source.low), high: unpack(source.high),
      };
      /** @type {Entry} */
      const entry = { label: source.label, colour: name, kind: source.kind, value: () => null };
      const line = (/** @type {number} */ width, opacity = "") => ({
        stroke: () => colour(name) + opacity,
        width,
        spanGaps: false,
      });
      if (source.kind === "points") {
        const pointSeries = { ...arrays, colour: name, standsOut: source.is_highlighted };
        points.push(pointSeries);
        entry.value = (u, at) => nearest(u, pointSeries, at);
      } else if (source.kind === "band") {
        const first = series.length;
        tables.push([arrays.x, arrays.low, arrays.high]);
        series.push(line(1, "a0"), line(1, "a0"));
        bands.push({ series: [first + 1, first], fill: () => `${colour(name)}66` });
        entry.value = (u) => [u.cursor.idxs[first], u.cursor.idxs[first + 1]]
          .map((i, k) => (i == null ? null : u.data[first + k][i]));
      } else {
        const at = series.length;
        tables.push([arrays.x, arrays.y]);
        series.push(line(1.5));
        entry.value = (u) => {
          const i = u.cursor.idxs[at];
          return i == null ? null : [u.data[at][i]];
        };
      }
      legend.push(entry);
    });
    // Points only extend the axis; they are not joined, because several can have the same x.
    const xValues = [...new Set(points.flatMap((arrays) => arrays.x))].sort((a, b) => a - b);
    if (xValues.length) tables.push([xValues]);
    // 2: gaps extend to the neighbouring values (JoinNullMode.Expand of uPlot).
    const nullModes = tables.map((table) => table.map(() => 2));
    const data = uPlot.join(tables, nullModes);
    series.slice(1).forEach((arrays, i) => {
      const isolated = isolatedIndices(data[i + 1]);
      arrays.points = { show: false, filter: () => isolated, size: 4, fill: arrays.stroke };
    });
    return { data, series, bands, points, legend };
  }

  // Isolated values between gaps, which no line reaches; undefined: only other series have a value.
  /** @param {any[]} values */
  function isolatedIndices(values) {
    const indices = values.flatMap((value, index) => (value === undefined ? [] : [index]));
    return indices.filter((index, k) => values[index] !== null
      && (values[indices[k - 1]] ?? null) === null && (values[indices[k + 1]] ?? null) === null);
  }

  /** @type {(u: any, one: Points, at: number) => any[] | null} */
  function nearest(u, points, position) {
    const maxDistance = 12;
    /** @type {number | null} */
    let nearestIndex = null;
    let distance = maxDistance;
    for (const index of indicesWithin(points, u.posToVal(position - maxDistance, "x"), u.posToVal(position + maxDistance, "x"))) {
      const candidateDistance = Math.abs(u.valToPos(points.x[index], "x") - position);
      if (candidateDistance < distance) [nearestIndex, distance] = [index, candidateDistance];
    }
    return nearestIndex === null ? null : [points.y[nearestIndex]];
  }

  // The range follows the visible lines and ordinary points. Highlighted points extend it by up to
  // a factor of three; points beyond are marked at the edge.
  /** @type {(u: any, low: number, high: number, points: Points[], levels: number[], log: boolean) => number[]} */
  function yRange(u, low, high, points, levels, log) {
    const { min, max } = u.scales.x;
    const [first, last] = u.series[0].idxs ?? [0, u.data[0].length - 1];
    /** @type {[number, number]} */
    const visibleRange = [u.data[0][first] ?? min, u.data[0][last] ?? max];
    const values = (/** @type {Points[]} */ pointSeries) => pointSeries.flatMap((one) =>
      indicesWithin(one, ...visibleRange).flatMap((i) => [one.y[i], one.low?.[i] ?? one.y[i],
        one.high?.[i] ?? one.y[i]]));
    const highlighted = points.filter((one) => one.standsOut);
    const plainValues = [low, high, ...values(points.filter((one) => !one.standsOut))]
      .filter(Number.isFinite);
    if (!plainValues.length) plainValues.push(...values(highlighted));
    if (!plainValues.length) plainValues.push(...levels);
    if (!plainValues.length) return [0, 1];
    let [bottom, top] = [Math.min(...plainValues), Math.max(...plainValues)];
    if (log) return uPlot.rangeLog(bottom, top, 10, false);
    const height = top - bottom || Math.abs(top) || 1;
    for (const y of values(highlighted)) {
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
  function drawPoints(u, points) {
    const { ctx, bbox } = u;
    const size = 3.5 * devicePixelRatio;
    const bottom = bbox.top + bbox.height;
    ctx.save();
    ctx.fillStyle = ctx.strokeStyle = colour(points.colour);
    ctx.lineWidth = 1.25 * devicePixelRatio;
    for (const index of indicesWithin(points, u.scales.x.min, u.scales.x.max)) {
      const x = u.valToPos(points.x[index], "x", true);
      const y = u.valToPos(points.y[index], "y", true);
      ctx.beginPath();
      if (points.low && points.high && points.low[index] !== null && points.high[index] !== null) {
        ctx.moveTo(x, Math.min(u.valToPos(points.low[index], "y", true), bottom));
        ctx.lineTo(x, Math.max(u.valToPos(points.high[index], "y", true), bbox.top));
        ctx.stroke();
        ctx.beginPath();
      }
      if (y < bbox.top || y > bottom) {
        const [edge, direction] = y < bbox.top ? [bbox.top, 1] : [bottom, -1];
        ctx.moveTo(x, edge);
        ctx.lineTo(x - size, edge + 2 * direction * size);
        ctx.lineTo(x + size, edge + 2 * direction * size);
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
    const { data, series, bands, points, legend } = plotParts(plot);
    const title = figure.querySelector("figcaption").textContent;
    const canvas = make("div", { class: "canvas", role: "img", "aria-label": title });
    const readout = make("ul", { class: "readout" });
    const xReadout = make("b", {});
    readout.append(make("li", {}, `${plot.x_label}: `, xReadout));
    for (const entry of legend.filter((item) => item.label)) {
      const dotClass = entry.kind === "points" ? "dots" : "";
      entry.shown = make("b", {});
      const swatch = make("i", { class: dotClass, style: `background: var(${entry.colour})` });
      readout.append(make("li", {}, swatch, `${entry.label}: `, entry.shown));
    }
    const updateReadout = (/** @type {any} */ u) => {
      const { left, idx } = u.cursor;
      const isOver = left >= 0 && idx != null;
      xReadout.textContent = isOver ? format(u.posToVal(left, "x"), 6) : "–";
      for (const entry of legend.filter((one) => one.label)) {
        const values = isOver ? entry.value(u, left) : null;
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
          setCursor: [updateReadout],
          drawClear: [(/** @type {any} */ u) => drawLevels(u, plot.levels)],
          draw: [(/** @type {any} */ u) => points.forEach((item) => drawPoints(u, item))],
        },
      },
      data,
      canvas,
    );
    figure.chart = chart;

    // Buttons for keyboard and touch, equivalent to dragging with the mouse
    const fullRange = [data[0][0], data[0].at(-1)];
    /** @type {(shift: number, factor: number) => void} */
    const moveWindow = (shift, factor) => {
      const { min, max } = chart.scales.x;
      const half = Math.min(0.5 * (max - min) * factor, 0.5 * (fullRange[1] - fullRange[0]));
      const middle = 0.5 * (min + max) + shift * (max - min);
      const centre = Math.min(Math.max(middle, fullRange[0] + half), fullRange[1] - half);
      chart.setScale("x", { min: centre - half, max: centre + half });
    };
    /** @type {(sign: string, words: string, action: () => void) => HTMLElement} */
    const zoomButton = (sign, label, action) => {
      const button = make("button", { type: "button", "aria-label": label, title: label }, sign);
      button.addEventListener("click", action);
      return button;
    };
    box.append(
      make("div", { class: "tools" },
        zoomButton("+", "Zoom in", () => moveWindow(0, 0.5)),
        zoomButton("−", "Zoom out", () => moveWindow(0, 2)),
        zoomButton("‹", "Move left", () => moveWindow(-0.25, 1)),
        zoomButton("›", "Move right", () => moveWindow(0.25, 1)),
        zoomButton("All", "Show all", () => chart.setScale("x", { min: fullRange[0], max: fullRange[1] })),
        make("p", {}, "Drag to zoom in, double-click to zoom out.")),
      canvas,
      readout,
    );
    updateReadout(chart);
    redraws.push(() => chart.redraw(false));
    new ResizeObserver(() => {
      const width = box.clientWidth;
      if (width && width !== chart.width) chart.setSize({ width, height: 300 });
    }).observe(box);
  }

  // Also called for content that a page shows later.
  /** @param {ParentNode} root */
  function draw(root) {
    root.querySelectorAll(".scroll").forEach((box) => overflowObserver.observe(box));
    root.querySelectorAll('.scroll[aria-label^="Table: "]').forEach((box) => tableTools(/** @type {HTMLElement} */ (box)));
    root.querySelectorAll("figure[id]").forEach((figure) => figureTools(/** @type {HTMLElement} */ (figure)));
    root.querySelectorAll(".chapters.tabs").forEach((box) => makeTabs(/** @type {HTMLElement} */ (box)));
    if (uPlot) root.querySelectorAll("figure.zoomable").forEach(zoomable);
  }

  draw(document);
  showTheme();
  return { draw, axis, colour, redraws };
})();
