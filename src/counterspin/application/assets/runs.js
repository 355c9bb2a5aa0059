// @ts-check
// The runs of a campaign, and plots of their records.

import { get, send } from "./api.js";
import { attempt, commandLine, labelled, make, warning, working } from "./dom.js";
import { jobStarter } from "./job.js";
import { campaignTabs, reachedStep } from "./tabs.js";

const CHART_HEIGHT = 190;

/**
 * Plots of the columns of a record with a common time axis.
 * @param {string} name
 * @param {string} run
 */
class RecordPlots {
  /**
   * @param {string} name
   * @param {string} run
   * @param {import("./answers.js").RecordOverview} overview
   */
  constructor(name, run, overview) {
    this.name = name;
    this.run = run;
    this.overview = overview;
    // Columns that share a chart: data and fit.
    this.columnsPerChart = overview.columns_per_plot;
    this.firstColumns = overview.columns.filter((/** @type {any} */ _, /** @type {number} */ index) => index % overview.columns_per_plot === 0);
    this.fullRange = [overview.first, overview.last];
    this.shownRange = [...this.fullRange];
    this.charts = /** @type {any[]} */ ([]);
    this.requestCount = 0;
    this.status = make("p", { class: "quiet", "aria-live": "polite" });
    this.boxes = this.firstColumns.map((column) =>
      make("div", { class: "canvas", role: "img", "aria-label": `${column.name}, ${column.unit}, over time` }));
    this.element = make("div", {}, this.tools(), ...this.boxes, this.status);
    new ResizeObserver(() => {
      const width = this.element.clientWidth;
      for (const chart of this.charts) {
        if (width && chart.width !== width) chart.setSize({ width, height: CHART_HEIGHT });
      }
    }).observe(this.element);
    globalThis.counterspin.redraws.push(() => this.charts.forEach((chart) => chart.redraw(false)));
  }

  tools() {
    /** @type {(sign: string, words: string, act: () => void) => HTMLElement} */
    const tool = (sign, label, action) =>
      make("button", { type: "button", "aria-label": label, title: label, onclick: action }, sign);
    return make("div", { class: "tools" },
      tool("+", "Zoom in", () => this.moveWindow(0, 0.5)),
      tool("−", "Zoom out", () => this.moveWindow(0, 2)),
      tool("‹", "Move left", () => this.moveWindow(-0.25, 1)),
      tool("›", "Move right", () => this.moveWindow(0.25, 1)),
      tool("All", "Show all", () => this.show(this.fullRange)),
      make("p", {}, "Drag to zoom in, double-click to zoom out."));
  }

  /**
   * @param {number} shift
   * @param {number} factor
   */
  moveWindow(shift, factor) {
    const [low, high] = this.shownRange;
    const [first, last] = this.fullRange;
    const halfWidth = Math.min(0.5 * (high - low) * factor, 0.5 * (last - first));
    const middle = 0.5 * (low + high) + shift * (high - low);
    const centre = Math.min(Math.max(middle, first + halfWidth), last - halfWidth);
    this.show([centre - halfWidth, centre + halfWidth]);
  }

  /** @param {number[]} window */
  async show(window) {
    this.shownRange = [...window];
    const requestNumber = ++this.requestCount;
    const [low, high] = window;
    const response = await attempt(this.status, () => get("record", {
      name: this.name, run: this.run, low, high,
      parts: Math.max(this.element.clientWidth, 300),
      fit: this.columnsPerChart > 1,
    }));
    // A later request has replaced this one.
    if (!response || requestNumber !== this.requestCount) return;
    if (!this.charts.length) this.createCharts();
    this.charts.forEach((chart, index) => {
      chart.batch(() => {
        chart.setData([response.time, ...response.columns.slice(index * this.columnsPerChart, (index + 1) * this.columnsPerChart)], false);
        chart.setScale("x", { min: low, max: high });
      });
    });
    this.status.textContent = response.is_complete
      ? "The plot shows every row."
      : "Each pixel column shows the minimum and maximum of several rows " +
        `(${this.overview.rows.toLocaleString("en")} rows in total).`;
  }

  createCharts() {
    const { axis, colour } = globalThis.counterspin;
    this.charts = this.boxes.map((/** @type {HTMLElement} */ box, /** @type {number} */ index) => {
      const { name, unit } = this.firstColumns[index];
      const stroke = () => colour(`--series-${(index % 6) + 1}`);
      const series = this.overview.columns.slice(index * this.columnsPerChart, (index + 1) * this.columnsPerChart).map(
        (column, /** @type {number} */ columnIndex) => ({
          label: column.name, points: { show: false }, width: columnIndex + 1,
          stroke: columnIndex ? () => colour("--ink") : stroke,
        }));
      const chart = new /** @type {any} */ (globalThis).uPlot({
        width: this.element.clientWidth,
        height: CHART_HEIGHT,
        legend: { show: this.columnsPerChart > 1 },
        cursor: { y: false, sync: { key: "record" }, drag: { x: true, y: false, dist: 4, setScale: false } },
        scales: { x: { time: false } },
        axes: [axis("time, s", 34), axis(`${this.columnsPerChart > 1 ? name.split(":")[0] : name}, ${unit}`, 70)],
        series: [{ label: "time, s" }, ...series],
        hooks: {
          setSelect: [(/** @type {any} */ u) => {
            if (u.select.width < 4) return;
            const low = u.posToVal(u.select.left, "x");
            const high = u.posToVal(u.select.left + u.select.width, "x");
            u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
            this.show([low, high]);
          }],
        },
      }, [[], []], box);
      chart.over.addEventListener("dblclick", () => this.show(this.fullRange));
      return chart;
    });
  }
}

/**
 * The page of a campaign's runs.
 * @param {string} name
 */
export async function runsView(name) {
  const campaign = await get("campaign", { name });
  const runs = campaign.run_list.filter((run) => run.bytes);
  const container = make("div");
  const select = make("select", {}, ...runs.map((run) =>
    make("option", { value: run.name },
      `${run.name}, ${Number((run.rate ?? 0).toPrecision(4))} rad/s`)));
  const checkContainer = make("div");
  const check = () => {
    // In a separate box, so that a late check of another run is not shown.
    const box = make("div", {}, working("Checking"));
    checkContainer.replaceChildren(box);
    return attempt(box, async () => {
      const response = await get("check", { name, run: select.value });
      const report = make("div");
      // Escaped by the report's own templates.
      report.innerHTML = response.html;
      report.querySelector("h1")?.remove();
      box.replaceChildren(report, commandLine(response.command));
      globalThis.counterspin.draw(report);
    });
  };
  const fitCheckbox = make("input", { type: "checkbox" });
  const show = () => {
    checkContainer.replaceChildren();
    const box = make("div", {}, working("Reading the record"));
    container.replaceChildren(box);
    return attempt(box, async () => {
      const { overview: overview } = await get("record-about", { name, run: select.value, fit: fitCheckbox.checked });
      if (!box.isConnected) return;
      if (!overview) {
        // The fit includes all runs.
        await jobStarter(box, () => send("POST", "fit", { name }), show)();
        return;
      }
      const plots = new RecordPlots(name, select.value, overview);
      const [start, stop] = overview.used;
      const file = runs.find((run) => run.name === select.value)?.record;
      const usedText = start !== null || stop !== null
        ? `; used from ${start ?? overview.first} s to ${stop ?? overview.last} s` : "";
      box.replaceChildren(
        make("p", { class: "quiet" }, `${overview.rows.toLocaleString("en")} rows in ${file}${usedText}`), plots.element);
      await plots.show(plots.fullRange);
    });
  };
  select.addEventListener("change", show);
  fitCheckbox.addEventListener("change", show);
  if (runs.length) setTimeout(show);
  const missing = campaign.missing.map(/** @param {string} file */ (file) => warning(`Missing file: ${file}`));
  return {
    title: `Records: ${campaign.title}`,
    content: [
      make("h1", {}, `Records: ${campaign.title}`), campaignTabs(name, "runs", reachedStep(campaign)),
      ...missing,
      ...(runs.length
        ? [make("div", { class: "row" }, labelled("Run", select),
          make("button", { type: "button", onclick: check }, "Check this run"),
          make("label", { class: "choice" }, fitCheckbox, "Data and fit, with the bias parabola removed")), checkContainer, container]
        : [make("p", {}, "No records to show. The records of rotating runs appear here when their files exist. " +
          "Records of poses and individual readings are listed with the result.")]),
    ],
  };
}
