// @ts-check
// Requests to the server of the page, with the key, which is stored for this window.

/** Name of the key in the session storage, and of the channel between windows. */
const KEY = "counterspin-key";

/** Timeout for the key from another window, ms. */
const KEY_TIMEOUT = 300;

/**
 * Windows of this very server, no other is heard: one that a link of the page has opened asks for
 * the key, and all have it anew from one that came by a link of the terminal.
 */
const channel = new BroadcastChannel(KEY);
channel.addEventListener("message", ({ data }) => {
  const key = sessionStorage.getItem(KEY);
  if (data.asked && key) channel.postMessage({ key });
  if (data.key && (data.renewed || !key)) sessionStorage.setItem(KEY, data.key);
});

/** The error for a refused request, with the status and the body of the response. */
export class RequestError extends Error {
  /**
   * @param {number} status
   * @param {{error: string, [key: string]: any}} body
   */
  constructor(status, body) {
    super(body.error);
    this.status = status;
    this.body = body;
  }
}

/**
 * Send a request with parameters.
 * @param {string} method
 * @param {string} name
 * @param {Record<string, any>} [parameters] words of a query, or the form
 * @returns {Promise<Response>}
 */
async function request(method, name, parameters = {}) {
  const definedParameters = Object.fromEntries(Object.entries(parameters).filter(([, value]) => value !== undefined));
  const isGet = method === "GET";
  const query = isGet && Object.keys(definedParameters).length ? `?${new URLSearchParams(definedParameters)}` : "";
  return exchange(`${name}${query}`, {
    method,
    headers: isGet ? {} : { "Content-Type": "application/json" },
    body: isGet ? undefined : JSON.stringify(definedParameters),
  });
}

/**
 * Add the key, if there is one.
 * @param {Record<string, string>} headers
 * @returns {Record<string, string>}
 */
function addKey(headers) {
  const key = sessionStorage.getItem(KEY);
  return key ? { ...headers, Authorization: `Bearer ${key}` } : headers;
}

/**
 * Send a request with the key.
 * @param {string} path
 * @param {{method: string, headers: Record<string, string>, body?: BodyInit}} request
 * @returns {Promise<Response>}
 */
async function exchange(path, request) {
  const key = sessionStorage.getItem(KEY);
  const headers = addKey(request.headers);
  let response;
  try {
    response = await fetch(`/api/${path}`, { ...request, headers });
  } catch {
    throw new RequestError(0, { error: "The server is not responding. Check that `counterspin serve` is still running." });
  }
  if (response.ok) return response;
  // The key of an earlier server is useless, also for other windows.
  if (response.status === 401 && sessionStorage.getItem(KEY) === key) sessionStorage.removeItem(KEY);
  const body = await response.json().catch(() => ({ error: `The server responded with status ${response.status}.` }));
  throw new RequestError(response.status, body);
}

/** @typedef {import("./answers.js").Answers} Answers */

/** @type {<N extends keyof Answers["GET"]>(name: N, said?: Record<string, any>) => Promise<Answers["GET"][N]>} */
export const get = async (name, parameters) => (await request("GET", name, parameters)).json();

/** @type {(name: string, said?: Record<string, any>) => Promise<string>} */
export const getText = async (name, parameters) => (await request("GET", name, parameters)).text();

/**
 * Request a text synchronously, because printing does not wait for promises.
 * @param {string} name
 * @param {Record<string, string>} parameters
 * @returns {string}
 */
export function getTextSync(name, parameters) {
  const request = new XMLHttpRequest();
  request.open("GET", `/api/${name}?${new URLSearchParams(parameters)}`, false);
  for (const [header, value] of Object.entries(addKey({}))) request.setRequestHeader(header, value);
  request.send();
  return request.status === 200 ? request.responseText : "";
}

/** @type {<M extends keyof Answers, N extends string & keyof Answers[M]>(method: M, name: N, said: Record<string, any>) => Promise<Answers[M][N]>} */
export const send = async (method, name, parameters) => (await request(method, name, parameters)).json();

/**
 * Upload a file.
 * @param {string} name
 * @param {File} file
 * @returns {Promise<import("./answers.js").StoredFile>}
 */
export const uploadFile = async (name, file) =>
  (await exchange(`files?${new URLSearchParams({ name })}`, {
    method: "POST",
    headers: { "Content-Type": "application/octet-stream" },
    body: file,
  })).json();

/**
 * Let the browser download a file, with a ticket.
 * @param {"report" | "file"} name
 * @param {Record<string, string>} parameters
 */
export async function saveFile(name, parameters) {
  const { ticket } = await send("POST", "ticket", { name, parameters });
  const link = document.createElement("a");
  link.href = `/api/ticket/${ticket}`;
  link.download = "";
  link.click();
}

/** Exchange the token of the link for the key; without a token, request the key from another window. */
export async function obtainKey() {
  const token = /^#token=(.+)$/.exec(location.hash)?.[1];
  if (token) {
    // Remove the token from the history and the address.
    history.replaceState(null, "", "#/");
    const response = await send("POST", "session", { token }).catch(() => null);
    if (response) {
      sessionStorage.setItem(KEY, response.key);
      channel.postMessage({ key: response.key, renewed: true });
    }
  }
  if (sessionStorage.getItem(KEY)) return;
  await new Promise((resolve) => {
    channel.addEventListener("message", ({ data }) => data.key && resolve(undefined));
    channel.postMessage({ asked: true });
    setTimeout(resolve, KEY_TIMEOUT);
  });
}
