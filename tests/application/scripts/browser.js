// As much of a browser as the page's scripts ask for: elements that remember what was done to them,
// a window's storage, channels between windows, and a server that a test answers for.

/** An element, or the document: children are elements and texts. */
export class Element {
  constructor(name) {
    Object.assign(this, { name, children: [], attributes: {}, listeners: {}, isConnected: true });
  }

  append(...children) {
    this.children.push(...children);
  }

  replaceChildren(...children) {
    this.children = children;
  }

  setAttribute(key, value) {
    this.attributes[key] = value;
  }

  removeAttribute(key) {
    delete this.attributes[key];
    delete this[key];
  }

  addEventListener(kind, listener) {
    (this.listeners[kind] ??= []).push(listener);
  }

  click() {
    clicked.push(this);
    for (const listener of this.listeners.click ?? []) listener();
  }

  get textContent() {
    return this.children.map((child) => child.textContent ?? child).join("");
  }

  set textContent(text) {
    this.children = text ? [text] : [];
  }
}

/** Whatever was clicked by the scripts themselves. */
export const clicked = [];
/** The page's place for what is said. */
export const said = new Element("p");
/** Requests so far; `answer` is what the next is answered by, or throws. */
export const server = { requests: [], answer: () => json({}) };
/** What other windows are told, and what hears them tell something. */
export const others = { told: [], hear: [] };

/** An answer with a document and a status. */
export const json = (document, status = 200) =>
  new Response(JSON.stringify(document), { status, headers: { "Content-Type": "application/json" } });

const kept = new Map();
globalThis.sessionStorage = {
  getItem: (key) => kept.get(key) ?? null,
  setItem: (key, value) => kept.set(key, value),
  removeItem: (key) => kept.delete(key),
};
globalThis.BroadcastChannel = class {
  addEventListener(_, listener) {
    others.hear.push((data) => listener({ data }));
  }

  postMessage(data) {
    others.told.push(data);
  }
};
globalThis.document = { createElement: (name) => new Element(name), getElementById: () => said };
globalThis.addEventListener = () => {};
// A clock of the page does not keep the tests from ending.
const { setInterval } = globalThis;
globalThis.setInterval = (...words) => setInterval(...words).unref();
globalThis.location = { hash: "" };
globalThis.history = { replaceState: (_state, _title, to) => (globalThis.location.hash = to) };
globalThis.fetch = async (path, request) => {
  server.requests.push({ path, ...request });
  return server.answer(path, request);
};
globalThis.XMLHttpRequest = class {
  constructor() {
    this.headers = {};
  }

  open(method, path, later) {
    Object.assign(this, { method, path, later });
  }

  setRequestHeader(key, value) {
    this.headers[key] = value;
  }

  send() {
    server.requests.push(this);
    Object.assign(this, server.answer(this.path, this));
  }
};
