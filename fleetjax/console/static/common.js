// What all pages share: a connection that comes back, and small ways to write into the page. Text goes in as text only.

export const byId = (id) => document.getElementById(id);

/** Write text into an element, if it says something else. */
export function write(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** Make an element with text and attributes. */
export function make(name, text = "", attributes = {}) {
  const element = document.createElement(name);
  element.textContent = text;
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  return element;
}

const FINAL = new Set(["over", "replaced"]);

/**
 * Open a WebSocket and keep it open until the session is over.
 * @param {string} path of the socket.
 * @param {Object<string, function(object)>} on what to do with a message, by its type; `open` is called at every connection.
 * @returns {function(object)} sends a message; nothing happens while there is no connection.
 */
export function connect(path, on) {
  const link = byId("link");
  let socket;
  let done = false;
  let delay = 250;

  const show = (text, state) => {
    write(link, text);
    link.dataset.state = state;
  };

  const open = () => {
    socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}${path}`);
    socket.onopen = () => {
      delay = 250;
      show("connected", "on");
      on.open?.();
    };
    socket.onmessage = (event) => {
      const message = JSON.parse(event.data);
      if (FINAL.has(message.type)) {
        done = true;
        show(message.type === "over" ? "session over" : "open elsewhere", "off");
      }
      on[message.type]?.(message);
    };
    socket.onclose = () => {
      on.closed?.(done);
      if (done) return;
      show("connection lost, trying again", "off");
      setTimeout(open, delay);
      delay = Math.min(2 * delay, 4000);
    };
  };

  open();
  return (message) => {
    if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message));
  };
}
