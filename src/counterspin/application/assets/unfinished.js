// @ts-check
// An unfinished import, stored for this window so that it survives a reload.

import { send } from "./api.js";
import { say } from "./dom.js";

/**
 * An import before its campaign is written: the folder, the files to confirm, all uploaded files,
 * the test type (empty: to be detected) and the answers so far.
 * @typedef {{folder: string, names: string[], uploaded: string[], test: string, answers: Record<string, string>}} Unfinished
 */

const KEY = "counterspin-import";

/** @param {Unfinished} state */
export const keepImport = (state) => sessionStorage.setItem(KEY, JSON.stringify(state));

export const forgetImport = () => sessionStorage.removeItem(KEY);

/** @returns {Unfinished|null} */
export const unfinishedImport = () => JSON.parse(sessionStorage.getItem(KEY) ?? "null");

/**
 * The import after its files have been moved to another folder.
 * @param {Unfinished} state
 * @param {string} folder
 * @returns {Unfinished}
 */
export function moveImport(state, folder) {
  const movedNames = (/** @type {string[]} */ names) => names.map((name) => `${folder}/${name.replace(/^.*\//, "")}`);
  return { ...state, folder, names: movedNames(state.names), uploaded: movedNames(state.uploaded) };
}

/** Move the files of the unfinished import to the trash, and offer to undo this. */
export async function discardImport() {
  const state = unfinishedImport();
  forgetImport();
  if (!state) return;
  const { place: trashName } = await send("POST", "discard", { folder: state.folder, names: state.uploaded });
  if (!trashName) return;
  say(`Moved the files of ${state.folder} to the trash.`, async () => {
    const { name } = await send("POST", "restore", { place: trashName });
    keepImport(moveImport(state, name));
    location.hash = "#/import";
  });
}
