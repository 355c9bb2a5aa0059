// @ts-check
// Import: the recorder's files of a new campaign, dropped, chosen or pasted.

import { bring, get, Refused, send } from "./api.js";
import { campaignAddress } from "./addresses.js";
import { Confirmation } from "./confirm.js";
import { attempt, labelled, make, working } from "./dom.js";
import { carryOut } from "./job.js";
import { stepList } from "./tabs.js";
import { requestTour } from "./tour.js";
import { discardImport, keepImport, unfinishedImport } from "./unfinished.js";

/** @typedef {import("./unfinished.js").Unfinished} Unfinished */

/** Kinds of test of a pasted table. */
const TABLES = ["tumble", "arm"];
/** Folders that are tried if files of the same name exist with other content. */
const MOST_FOLDERS = 9;

/** @type {{files: File[], folder: string} | null} files that another page has passed on */
let passed = null;

/**
 * A name for the folder of a campaign: the common beginning of its files' names, or the date.
 * @param {string[]} names of files
 * @param {string} date such as 2026-03-01
 * @param {Set<string>} taken names in use
 */
export function folderName(names, date, taken) {
  const stems = names.map((name) => name.replace(/\.[^.]*$/, ""));
  let common = stems[0] ?? "";
  for (const stem of stems) while (!stem.startsWith(common)) common = common.slice(0, -1);
  if (stems.length > 1) common = common.replace(/[\d\s._-]+$/u, "");
  const clean = common.replace(/[^\p{L}\p{N}_-]+/gu, "-").replace(/^-+|-+$/g, "");
  const base = clean.length < 3 ? `campaign-${date}` : clean;
  for (let count = 1; ; count++) {
    const name = count > 1 ? `${base}-${count}` : base;
    if (!taken.has(name)) return name;
  }
}

/**
 * The area that takes files.
 * @param {(files: File[], folder: string) => any} take
 */
function importPanel(take) {
  const folder = make("input", { autocomplete: "off", placeholder: "derived from the file names" });
  const files = make("input", { type: "file", multiple: true, id: "exports" });
  const takeFiles = (/** @type {Iterable<File>|null|undefined} */ list) => {
    const found = [...list ?? []];
    if (found.length) take(found, folder.value.trim());
  };
  files.addEventListener("change", () => takeFiles(files.files));
  const place = make("div");
  const sample = make("button", {
    type: "button",
    onclick: carryOut(place, () => send("POST", "sample", {}), (job) => {
      requestTour(job.output);
      location.hash = campaignAddress(job.output);
    }),
  }, "Open a sample campaign");
  const zone = make("div", { class: "drop" },
    make("h2", {}, "Drop your recorder’s files here"),
    make("p", { class: "quiet" }, "One file per run, or a single table of readings: CSV, text, Excel, Parquet, HDF5, MATLAB, TDMS or " +
      "LabVIEW. The files stay on this machine."),
    make("div", { class: "row" }, labelled("Recorder files", files), labelled("Folder for the new campaign (optional)", folder), sample),
    pastedTable((file) => takeFiles([file])), place);
  zone.addEventListener("dragover", (event) => {
    event.preventDefault();
    zone.classList.add("over");
  });
  zone.addEventListener("dragleave", () => zone.classList.remove("over"));
  zone.addEventListener("drop", (event) => {
    event.preventDefault();
    zone.classList.remove("over");
    takeFiles(event.dataTransfer?.files);
  });
  return zone;
}

/** The same area on another page, which leads to that of the import, with a link to an unfinished import. */
export function importEntry() {
  const state = unfinishedImport();
  const panel = importPanel((files, folder) => {
    passed = { files, folder };
    location.hash = "#/import";
  });
  return make("div", {},
    state ? make("p", { class: "unfinished" }, make("a", { href: "#/import" }, `Continue the import of ${state.folder}`)) : null, panel);
}

/**
 * A table that is typed or pasted, as a file.
 * @param {(file: File) => void} take
 */
function pastedTable(take) {
  const text = make("textarea", { rows: 6, spellcheck: "false", autocomplete: "off",
    placeholder: "position_deg\treading_mA\n0\t1.2503\n30\t1.0825" });
  let count = 0;
  return make("details", {}, make("summary", {}, "Paste a table"),
    labelled("Table copied from a spreadsheet: a header row, then one row per reading", text),
    make("button", {
      type: "button",
      // A changed table is another file, because no file is replaced.
      onclick: () => take(new File([asTable(text.value)], `readings${count++ ? `-${count}` : ""}.txt`, { type: PASTED })),
    }, "Use this table"));
}

/** The media type that marks a pasted table. */
const PASTED = "text/plain;pasted";

/**
 * A text as lines of a file, without empty ones.
 * @param {string} text
 */
export const asTable = (text) =>
  `${text.split(/\r\n?|\n/).map((line) => line.trimEnd()).filter(Boolean).join("\n")}\n`;

/**
 * Upload files into a folder, which has another name if one of them exists there with other content.
 * @param {File[]} files
 * @param {string} typed the folder; empty: suggested
 * @param {(text: string) => void} show the progress
 * @param {(folder: string, name: string) => void} uploaded called for each file
 * @returns {Promise<{folder: string, names: string[]}>}
 */
async function upload(files, typed, show, uploaded) {
  const { campaigns } = await get("folder");
  const taken = new Set(campaigns.map((/** @type {{name: string}} */ campaign) => campaign.name));
  const date = new Date().toISOString().slice(0, 10);
  for (let count = 1; ; count++) {
    const folder = typed || folderName(files.map(({ name }) => name), date, taken);
    try {
      const names = [];
      for (const [place, file] of files.entries()) {
        show(`Uploading ${file.name} (${place + 1} of ${files.length})`);
        const { name } = await bring(`${folder}/${file.name}`, file);
        names.push(name);
        uploaded(folder, name);
      }
      return { folder, names };
    } catch (error) {
      const exists = error instanceof Refused && error.status === 422 && error.message.includes("exists");
      if (typed || !exists || count === MOST_FOLDERS) throw error;
      taken.add(folder);
    }
  }
}

/** The page that imports files, and confirms the contents found in them. */
export async function importView() {
  const place = make("div");
  const title = make("h1", {}, "New campaign");
  const steps = make("nav", { class: "steps", "aria-label": "Campaign steps" }, stepList(0));
  /** @type {Confirmation|null} */
  let confirmation = null;
  const show = (/** @type {string} */ text) => place.replaceChildren(working(text));

  /**
   * Show the Confirm step.
   * @param {Unfinished} state
   * @param {string[]|null} tests kinds of test that are possible; null: any
   */
  const open = async (state, tests) => {
    show("Reading the files");
    const next = new Confirmation(place, state, tests);
    confirmation = next;
    await next.update();
    if (next !== confirmation) return;
    title.textContent = state.folder;
    panel.classList.add("compact");
    steps.replaceChildren(stepList(1));
  };
  let last = /** @type {Promise<any>} */ (Promise.resolve());
  /**
   * Do one thing after the other, so that files that are chosen during an upload wait for its end.
   * @param {() => Promise<void>} work
   */
  const queued = (work) => {
    last = last.then(() => attempt(place, work));
  };
  const take = (/** @type {File[]} */ files, /** @type {string} */ typed) => queued(async () => {
    confirmation?.end();
    discardButton.hidden = false;
    const before = unfinishedImport() ?? { folder: "", names: [], uploaded: [], test: "", answers: {} };
    let state = before;
    const { folder, names } = await upload(files, typed || before.folder, show, (target, name) => {
      const earlier = target === state.folder ? state.uploaded : [];
      state = { ...before, folder: target, names: [], uploaded: [...new Set([...earlier, name])] };
      keepImport(state);
    });
    await open({ ...state, folder, names, test: "" }, files[0].type === PASTED ? TABLES : null);
  });
  const discard = () => queued(async () => {
    confirmation?.end();
    show("Moving the files to the trash");
    await discardImport();
    location.hash = "#/";
  });
  const panel = importPanel(take);
  const state = unfinishedImport();
  const discardButton = make("button", { type: "button", onclick: discard, hidden: !state }, "Discard");
  if (passed) {
    if (state) await discardImport();
    take(passed.files, passed.folder);
  } else if (state?.names.length) {
    queued(() => open(state, null));
  }
  passed = null;
  return {
    title: "New campaign",
    content: [
      make("div", { class: "head" }, title, discardButton),
      steps, panel, place,
    ],
  };
}
