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

  // Chapters as tabs on a screen; on paper they follow one another

  const TAB = "counterspin-tab";

  /** @param {HTMLElement} box with a section for each chapter */
  function tabs(box) {
    const sections = /** @type {HTMLElement[]} */ ([...box.children]);
    const bar = make("div", { class: "tablist", role: "tablist", "aria-label": "Chapters" });
    /** @type {(chosen: number, focus?: boolean) => void} */
    const open = (chosen, focus = false) => buttons.forEach((tab, place) => {
      const selected = place === chosen;
      tab.setAttribute("aria-selected", String(selected));
      tab.tabIndex = selected ? 0 : -1;
      sections[place].classList.toggle("open", selected);
      if (selected && focus) tab.focus();
    });
    const buttons = sections.map((section, place) => {
      const heading = /** @type {HTMLElement} */ (section.querySelector("h2"));
      section.id = `${heading.id}-panel`;
      const tab = make("button", { type: "button", role: "tab", id: `${heading.id}-tab`, "aria-controls": section.id });
      tab.append(...heading.cloneNode(true).childNodes);
      section.setAttribute("role", "tabpanel");
      section.setAttribute("aria-labelledby", tab.id);
      tab.addEventListener("click", () => {
        open(place);
        try {
          sessionStorage.setItem(TAB, heading.id);
        } catch { /* nothing is kept */ }
      });
      return tab;
    });
    bar.addEventListener("keydown", (event) => {
      const now = buttons.findIndex((tab) => tab.tabIndex === 0);
      /** @type {Record<string, number>} */
      const targets = { ArrowLeft: now - 1, ArrowRight: now + 1, Home: 0, End: buttons.length - 1 };
      if (!(event.key in targets)) return;
      event.preventDefault();
      open((targets[event.key] + buttons.length) % buttons.length, true);
    });
    bar.append(...buttons);
    box.prepend(bar);
    box.classList.add("tabbed");
    const follow = () => {
      const target = document.getElementById(location.hash.slice(1));
      const place = sections.findIndex((section) => target && section.contains(target));
      if (place < 0 || !target) return;
      open(place);
      target.scrollIntoView();
    };
    let kept = null;
    try {
      kept = sessionStorage.getItem(TAB);
    } catch { /* nothing is kept */ }
    open(Math.max(sections.findIndex((section) => section.id === `${kept}-panel`), 0));
    addEventListener("hashchange", follow);
    follow();
  }

  // Tables to copy and save, figures to save

  /** @type {(name: string, type: string, content: BlobPart) => void} */
  function saveAs(name, type, content) {
    const link = make("a", { download: name, href: URL.createObjectURL(new Blob([content], { type })) });
    link.click();
    setTimeout(() => URL.revokeObjectURL(/** @type {HTMLAnchorElement} */ (link).href), 10000);
  }

  /** @param {string} text */
  const fileName = (text) => text.replace(/[^A-Za-z0-9]+/g, "-").replace(/^-|-$/g, "").toLowerCase();

  /** @type {(words: string, of: string, work: (button: HTMLElement) => void | Promise<void>) => HTMLElement} */
  function tool(words, of, work) {
    const button = make("button", { type: "button", "aria-label": `${words}: ${of}` }, words);
    const failure = make("span", { role: "alert" });
    button.addEventListener("click", async () => {
      failure.remove();
      try {
        await work(button);
      } catch (error) {
        failure.textContent = words === "Copy"
          ? "Not copied: the browser refuses access to the clipboard. Select the table and copy it, or save it as CSV."
          : `Not saved as ${words}: ${/** @type {Error} */ (error).message || "the browser cannot draw the figure"}. Reload the page and try again.`;
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
    const copied = document.execCommand("copy");
    area.remove();
    if (!copied) throw new Error("copying is refused");
  }

  /** @param {HTMLElement} box */
  function tableTools(box) {
    const table = /** @type {HTMLTableElement} */ (box.querySelector("table"));
    const label = (box.getAttribute("aria-label") ?? "").replace(/^Table: /, "");
    const quote = (/** @type {string} */ cell) => {
      const plain = cell.replace(/−/g, "-");
      return /[",\n]/.test(plain) ? `"${plain.replaceAll('"', '""')}"` : plain;
    };
    box.before(make("div", { class: "tools save" },
      tool("Copy", label, async (button) => {
        await copy(cellsOf(table).map((row) => row.join("\t")).join("\n"));
        button.textContent = "Copied";
        setTimeout(() => { button.textContent = "Copy"; }, 2000);
      }),
      tool("CSV", label, () => saveAs(`${fileName(label)}.csv`, "text/csv;charset=utf-8",
        `\ufeff${cellsOf(table).map((row) => row.map(quote).join(",")).join("\r\n")}\r\n`))));
  }

  /** @param {HTMLElement} figure */
  function figureTools(figure) {
    const caption = /** @type {HTMLElement} */ (figure.querySelector("figcaption"));
    const title = caption.textContent ?? "figure";
    const still = /** @type {any} */ (figure.querySelector(".still"));
    const drawing = async () => {
      const text = still.querySelector("svg")?.outerHTML ?? await still.fetchPicture();
      const svg = /** @type {Element} */ (new DOMParser().parseFromString(text, "text/html").querySelector("svg"));
      const [, , width, height] = (svg.getAttribute("viewBox") ?? "0 0 800 500").split(/[\s,]+/).map(Number);
      svg.setAttribute("width", String(width));
      svg.setAttribute("height", String(height));
      svg.setAttribute("style", `background: ${colour("--ground")}`);
      const whole = new XMLSerializer().serializeToString(svg)
        .replace(/var\((--[\w-]+)[^)]*\)/g, (_, name) => colour(name));
      return { whole, width, height };
    };
    caption.after(make("div", { class: "tools save" },
      tool("SVG", title, async () => saveAs(`${fileName(title)}.svg`, "image/svg+xml", (await drawing()).whole)),
      tool("PNG", title, async () => {
        const { whole, width, height } = await drawing();
        const image = new Image();
        image.src = `data:image/svg+xml;charset=utf-8,${encodeURIComponent(whole)}`;
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
        const mine = { ...one, colour: name, standsOut: source.is_highlighted };
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
    const zoomButton = (sign, words, action) => {
      const one = make("button", { type: "button", "aria-label": words, title: words }, sign);
      one.addEventListener("click", action);
      return one;
    };
    box.append(
      make("div", { class: "tools" },
        zoomButton("+", "Zoom in", () => see(0, 0.5)),
        zoomButton("−", "Zoom out", () => see(0, 2)),
        zoomButton("‹", "Move left", () => see(-0.25, 1)),
        zoomButton("›", "Move right", () => see(0.25, 1)),
        zoomButton("All", "Show all", () => chart.setScale("x", { min: whole[0], max: whole[1] })),
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
    part.querySelectorAll('.scroll[aria-label^="Table: "]').forEach((box) => tableTools(/** @type {HTMLElement} */ (box)));
    part.querySelectorAll("figure[id]").forEach((figure) => figureTools(/** @type {HTMLElement} */ (figure)));
    part.querySelectorAll(".chapters.tabs").forEach((box) => tabs(/** @type {HTMLElement} */ (box)));
    if (uPlot) part.querySelectorAll("figure.zoomable").forEach(zoomable);
  }

  draw(document);
  showTheme();
  return { draw, axis, colour, redraws };
})();
