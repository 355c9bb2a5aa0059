// @ts-check
// The runs of a campaign, and their records through a window of time.

import { get, send } from "./api.js";
import { attempt, commandLine, labelled, make, warning, working } from "./dom.js";
import { carryOut } from "./job.js";
import { campaignTabs, reachedBy } from "./tabs.js";

const HEIGHT = 190;

/**
 * The columns of one record, one below the other; all show the same time.
 * @param {string} name
 * @param {string} run
 */
class RecordPlots {
  /**
   * @param {string} name
   * @param {string} run
   * @param {import("./answers.js").RecordOverview} about
   */
  constructor(name, run, about) {
    this.name = name;
    this.run = run;
    this.about = about;
    // Columns that share a chart: data and fit.
    this.together = about.together;
    this.first = about.columns.filter((/** @type {any} */ _, /** @type {number} */ i) => i % about.together === 0);
    this.whole = [about.first, about.last];
    this.window = [...this.whole];
    this.charts = /** @type {any[]} */ ([]);
    this.asked = 0;
    this.words = make("p", { class: "quiet", "aria-live": "polite" });
    this.boxes = this.first.map((c) =>
      make("div", { class: "canvas", role: "img", "aria-label": `${c.name}, ${c.unit}, over time` }));
    this.element = make("div", {}, this.tools(), ...this.boxes, this.words);
    new ResizeObserver(() => {
      const width = this.element.clientWidth;
      for (const chart of this.charts) {
        if (width && chart.width !== width) chart.setSize({ width, height: HEIGHT });
      }
    }).observe(this.element);
    globalThis.counterspin.redraws.push(() => this.charts.forEach((chart) => chart.redraw(false)));
  }

  tools() {
    /** @type {(sign: string, words: string, act: () => void) => HTMLElement} */
    const tool = (sign, words, act) =>
      make("button", { type: "button", "aria-label": words, title: words, onclick: act }, sign);
    return make("div", { class: "tools" },
      tool("+", "Zoom in", () => this.see(0, 0.5)),
      tool("−", "Zoom out", () => this.see(0, 2)),
      tool("‹", "Move left", () => this.see(-0.25, 1)),
      tool("›", "Move right", () => this.see(0.25, 1)),
      tool("All", "Show all", () => this.show(this.whole)),
      make("p", {}, "Drag to zoom in, double-click to zoom out."));
  }

  /**
   * @param {number} shift
   * @param {number} factor
   */
  see(shift, factor) {
    const [low, high] = this.window;
    const [first, last] = this.whole;
    const half = Math.min(0.5 * (high - low) * factor, 0.5 * (last - first));
    const middle = 0.5 * (low + high) + shift * (high - low);
    const centre = Math.min(Math.max(middle, first + half), last - half);
    this.show([centre - half, centre + half]);
  }

  /** @param {number[]} window */
  async show(window) {
    this.window = [...window];
    const mine = ++this.asked;
    const [low, high] = window;
    const told = await attempt(this.words, () => get("record", {
      name: this.name, run: this.run, low, high,
      parts: Math.max(this.element.clientWidth, 300),
      fit: this.together > 1,
    }));
    // A later look has overtaken this one.
    if (!told || mine !== this.asked) return;
    if (!this.charts.length) this.make();
    this.charts.forEach((chart, i) => {
      chart.batch(() => {
        chart.setData([told.time, ...told.columns.slice(i * this.together, (i + 1) * this.together)], false);
        chart.setScale("x", { min: low, max: high });
      });
    });
    this.words.textContent = told.whole
      ? "The plot shows every row."
      : "Each pixel column shows the minimum and maximum of several rows " +
        `(${this.about.rows.toLocaleString("en")} rows in total).`;
  }

  make() {
    const { axis, colour } = globalThis.counterspin;
    this.charts = this.boxes.map((/** @type {HTMLElement} */ box, /** @type {number} */ i) => {
      const { name, unit } = this.first[i];
      const stroke = () => colour(`--series-${(i % 6) + 1}`);
      const series = this.about.columns.slice(i * this.together, (i + 1) * this.together).map(
        (column, /** @type {number} */ place) => ({
          label: column.name, points: { show: false }, width: place + 1,
          stroke: place ? () => colour("--ink") : stroke,
        }));
      const chart = new /** @type {any} */ (globalThis).uPlot({
        width: this.element.clientWidth,
        height: HEIGHT,
        legend: { show: this.together > 1 },
        cursor: { y: false, sync: { key: "record" }, drag: { x: true, y: false, dist: 4, setScale: false } },
        scales: { x: { time: false } },
        axes: [axis("time, s", 34), axis(`${this.together > 1 ? name.split(":")[0] : name}, ${unit}`, 70)],
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
      chart.over.addEventListener("dblclick", () => this.show(this.whole));
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
  const place = make("div");
  const select = make("select", {}, ...runs.map((run) =>
    make("option", { value: run.name },
      `${run.name}, ${Number((run.rate ?? 0).toPrecision(4))} rad/s`)));
  const judgement = make("div");
  const check = () => {
    // In a box of its own, so that the late check of another run is shown nowhere.
    const box = make("div", {}, working("Checking"));
    judgement.replaceChildren(box);
    return attempt(box, async () => {
      const told = await get("check", { name, run: select.value });
      const part = make("div");
      // Escaped by the report's own templates.
      part.innerHTML = told.html;
      part.querySelector("h1")?.remove();
      box.replaceChildren(part, commandLine(told.command));
      globalThis.counterspin.draw(part);
    });
  };
  const fitted = make("input", { type: "checkbox" });
  const show = () => {
    judgement.replaceChildren();
    const box = make("div", {}, working("Reading the record"));
    place.replaceChildren(box);
    return attempt(box, async () => {
      const { overview: about } = await get("record-about", { name, run: select.value, fit: fitted.checked });
      if (!box.isConnected) return;
      if (!about) {
        // Once fitted, all runs are.
        await carryOut(box, () => send("POST", "fit", { name }), show)();
        return;
      }
      const plots = new RecordPlots(name, select.value, about);
      const [start, stop] = about.used;
      const file = runs.find((run) => run.name === select.value)?.record;
      const used = start !== null || stop !== null
        ? `; used from ${start ?? about.first} s to ${stop ?? about.last} s` : "";
      box.replaceChildren(
        make("p", { class: "quiet" }, `${about.rows.toLocaleString("en")} rows in ${file}${used}`), plots.element);
      await plots.show(plots.whole);
    });
  };
  select.addEventListener("change", show);
  fitted.addEventListener("change", show);
  if (runs.length) setTimeout(show);
  const missing = campaign.missing.map(/** @param {string} file */ (file) => warning(`Missing file: ${file}`));
  return {
    title: `Records: ${campaign.title}`,
    content: [
      make("h1", {}, campaign.title), campaignTabs(name, "runs", reachedBy(campaign)),
      ...missing,
      ...(runs.length
        ? [make("div", { class: "row" }, labelled("Run", select),
          make("button", { type: "button", onclick: check }, "Check this run"),
          make("label", { class: "choice" }, fitted, "Data and fit, with the bias parabola removed")), judgement, place]
        : [make("p", {}, "No records to show. The records listed in the description appear here when their files exist. " +
          "Individual readings are listed with the result.")]),
    ],
  };
}
