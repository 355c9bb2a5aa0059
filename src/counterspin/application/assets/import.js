// @ts-check
// Import of a recorder's files for a new campaign.

import { uploadFile, get, RequestError, send } from "./api.js";
import { campaignAddress } from "./addresses.js";
import { Confirmation } from "./confirm.js";
import { attempt, labelled, make, working } from "./dom.js";
import { jobStarter } from "./job.js";
import { stepList } from "./tabs.js";
import { requestTour } from "./tour.js";
import { discardImport, keepImport, unfinishedImport } from "./unfinished.js";

/** @typedef {import("./unfinished.js").Unfinished} Unfinished */

/** Test types of a pasted table. */
const TABLE_TESTS = ["tumble", "arm"];
/** Number of folder names tried if files with the same name and other content exist. */
const MAX_FOLDERS = 9;

/** @type {{files: File[], folder: string} | null} files that another page has passed on */
let passedFiles = null;

/**
 * A name for the folder of a campaign: the common prefix of its file names, or the date.
 * @param {string[]} names of files
 * @param {string} date such as 2026-03-01
 * @param {Set<string>} takenNames names in use
 */
export function folderName(names, date, takenNames) {
  const stems = names.map((name) => name.replace(/\.[^.]*$/, ""));
  let commonPrefix = stems[0] ?? "";
  for (const stem of stems) while (!stem.startsWith(commonPrefix)) commonPrefix = commonPrefix.slice(0, -1);
  if (stems.length > 1) commonPrefix = commonPrefix.replace(/[\d\s._-]+$/u, "");
  const cleanPrefix = commonPrefix.replace(/[^\p{L}\p{N}_-]+/gu, "-").replace(/^-+|-+$/g, "");
  const baseName = cleanPrefix.length < 3 ? `campaign-${date}` : cleanPrefix;
  for (let count = 1; ; count++) {
    const name = count > 1 ? `${baseName}-${count}` : baseName;
    if (!takenNames.has(name)) return name;
  }
}

/**
 * The area that takes files.
 * @param {(files: File[], folder: string) => any} onFiles
 */
function importPanel(onFiles) {
  const folder = make("input", { autocomplete: "off", placeholder: "derived from the file names" });
  const files = make("input", { type: "file", multiple: true, id: "exports" });
  const takeFiles = (/** @type {Iterable<File>|null|undefined} */ fileList) => {
    const files = [...fileList ?? []];
    if (files.length) onFiles(files, folder.value.trim());
  };
  files.addEventListener("change", () => takeFiles(files.files));
  const container = make("div");
  const sample = make("button", {
    type: "button",
    onclick: jobStarter(container, () => send("POST", "sample", {}), (job) => {
      requestTour(job.output);
      location.hash = campaignAddress(job.output);
    }),
  }, "Open a sample campaign");
  const dropZone = make("div", { class: "drop" },
    make("h2", {}, "Drop your recorder’s files here"),
    make("p", { class: "quiet" }, "One file per run, or a single table of readings: CSV, text, Excel, Parquet, HDF5, MATLAB, TDMS or " +
      "LabVIEW. The files stay on this machine."),
    make("div", { class: "row" }, labelled("Recorder files", files), labelled("Folder for the new campaign (optional)", folder), sample),
    pastedTable((file) => takeFiles([file])),
    make("p", { class: "quiet note" }, "If you choose files again, they replace the files below. Choose the files of all runs together."), container);
  dropZone.addEventListener("dragover", (event) => {
    event.preventDefault();
    dropZone.classList.add("over");
  });
  dropZone.addEventListener("dragleave", () => dropZone.classList.remove("over"));
  dropZone.addEventListener("drop", (event) => {
    event.preventDefault();
    dropZone.classList.remove("over");
    takeFiles(event.dataTransfer?.files);
  });
  return dropZone;
}

/** The same area on another page; it passes files to the import page, and links to an unfinished import. */
export function importEntry() {
  const state = unfinishedImport();
  const panel = importPanel((files, folder) => {
    passedFiles = { files, folder };
    location.hash = "#/import";
  });
  return make("div", {},
    state ? make("p", { class: "unfinished" }, make("a", { href: "#/import" }, `Continue the import of ${state.folder}`)) : null, panel);
}

/**
 * A table that is typed or pasted, as a file.
 * @param {(file: File) => void} onFile
 */
function pastedTable(onFile) {
  const text = make("textarea", { rows: 6, spellcheck: "false", autocomplete: "off",
    placeholder: "position_deg\treading_mA\n0\t1.2503\n30\t1.0825" });
  let count = 0;
  return make("details", {}, make("summary", {}, "Paste a table"),
    labelled("Table copied from a spreadsheet: a header row, then one row per reading", text),
    make("button", {
      type: "button",
      // A changed table gets another name, because files are never replaced.
      onclick: () => onFile(new File([normalizeTable(text.value)], `readings${count++ ? `-${count}` : ""}.txt`, { type: PASTED_TYPE })),
    }, "Use this table"));
}

/** The media type that marks a pasted table. */
const PASTED_TYPE = "text/plain;pasted";

/**
 * A text with normalised line ends and without empty lines.
 * @param {string} text
 */
export const normalizeTable = (text) =>
  `${text.split(/\r\n?|\n/).map((line) => line.trimEnd()).filter(Boolean).join("\n")}\n`;

/**
 * The files by name. A file that was chosen twice appears once; other files with the same name get a number.
 * @param {File[]} files
 * @returns {Map<string, File>}
 */
export function filesByName(files) {
  const byName = /** @type {Map<string, File>} */ (new Map());
  for (const file of files) {
    if ([...byName.values()].some(({ name, size, lastModified }) =>
      name === file.name && size === file.size && lastModified === file.lastModified)) continue;
    const [, stem, suffix = ""] = /** @type {RegExpExecArray} */ (/^(.*?)(\.[^.]*)?$/.exec(file.name));
    let name = file.name;
    for (let count = 2; byName.has(name); count++) name = `${stem}-${count}${suffix}`;
    byName.set(name, file);
  }
  return byName;
}

/**
 * Upload files into a folder. If a file with the same name and other content exists, move the files of the
 * unfinished import to the trash, or use another folder name.
 * @param {File[]} files
 * @param {string} requestedFolder the folder; empty: suggested
 * @param {string} importFolder the folder of the unfinished import; empty: none
 * @param {(text: string) => void} showProgress the progress
 * @param {(folder: string, name: string) => void} onUploaded called for each file
 * @returns {Promise<{folder: string, names: string[]}>}
 */
async function upload(files, requestedFolder, importFolder, showProgress, onUploaded) {
  const { campaigns } = await get("folder");
  const takenNames = new Set(campaigns.map((/** @type {{name: string}} */ campaign) => campaign.name));
  const date = new Date().toISOString().slice(0, 10);
  const namedFiles = [...filesByName(files)];
  // Twice: before and after its files are moved to the trash.
  const importFolders = importFolder ? [importFolder, importFolder] : [];
  for (let count = 1; ; count++) {
    const folder = requestedFolder || importFolders.shift() || folderName(files.map(({ name }) => name), date, takenNames);
    try {
      const names = [];
      for (const [index, [fileName, file]] of namedFiles.entries()) {
        showProgress(`Uploading ${fileName} (${index + 1} of ${namedFiles.length})`);
        const { name } = await uploadFile(`${folder}/${fileName}`, file);
        names.push(name);
        onUploaded(folder, name);
      }
      return { folder, names };
    } catch (error) {
      const isConflict = error instanceof RequestError && error.status === 422 && error.message.includes("exists");
      if (requestedFolder || !isConflict || count === MAX_FOLDERS) throw error;
      if (importFolders.length) await discardImport();
      else takenNames.add(folder);
    }
  }
}

/** The page that imports files, and confirms the contents found in them. */
export async function importView() {
  const container = make("div");
  const title = make("h1", {}, "New campaign");
  const steps = make("nav", { class: "steps", "aria-label": "Campaign steps" }, stepList(0));
  /** @type {Confirmation|null} */
  let confirmation = null;
  const show = (/** @type {string} */ text) => container.replaceChildren(working(text));

  /**
   * Show the Confirm step.
   * @param {Unfinished} state
   * @param {string[]|null} tests test types that are possible; null: any
   */
  const open = async (state, tests) => {
    show("Reading the files");
    const newConfirmation = new Confirmation(container, state, tests);
    confirmation = newConfirmation;
    await newConfirmation.update();
    if (newConfirmation !== confirmation) return;
    title.textContent = state.folder;
    panel.classList.add("compact");
    steps.replaceChildren(stepList(1));
  };
  let pending = /** @type {Promise<any>} */ (Promise.resolve());
  /**
   * Run tasks one after the other, so that files chosen during an upload wait.
   * @param {() => Promise<void>} work
   */
  const enqueue = (work) => {
    pending = pending.then(() => attempt(container, work));
  };
  const importFiles = (/** @type {File[]} */ files, /** @type {string} */ requestedFolder) => enqueue(async () => {
    confirmation?.end();
    discardButton.hidden = false;
    const initialState = unfinishedImport() ?? { folder: "", names: [], uploaded: [], test: "", answers: {} };
    let state = initialState;
    const { folder, names } = await upload(files, requestedFolder, initialState.folder, show, (target, name) => {
      const earlierFiles = target === state.folder ? state.uploaded : [];
      state = { ...initialState, folder: target, names: [], uploaded: [...new Set([...earlierFiles, name])] };
      keepImport(state);
    });
    await open({ ...state, folder, names, test: "" }, files[0].type === PASTED_TYPE ? TABLE_TESTS : null);
  });
  const discard = () => enqueue(async () => {
    confirmation?.end();
    show("Moving the files to the trash");
    await discardImport();
    location.hash = "#/";
  });
  const panel = importPanel(importFiles);
  const state = unfinishedImport();
  const discardButton = make("button", { type: "button", onclick: discard, hidden: !state }, "Discard");
  if (passedFiles) {
    if (state) await discardImport();
    importFiles(passedFiles.files, passedFiles.folder);
  } else if (state?.names.length) {
    enqueue(() => open(state, null));
  }
  passedFiles = null;
  return {
    title: "New campaign",
    content: [
      make("div", { class: "head" }, title, discardButton),
      steps, panel, container,
    ],
  };
}
