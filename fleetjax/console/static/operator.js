// One person's seat: the robot that needs help, why, and the keys that act on it.

import { byId, connect, make, write } from "./common.js";

const KEYS = {
  ArrowRight: "right", ArrowUp: "up", ArrowLeft: "left", ArrowDown: "down",
  KeyD: "right", KeyW: "up", KeyA: "left", KeyS: "down", Space: "stop",
};
const SIGNS = { right: "\u2192", up: "\u2191", left: "\u2190", down: "\u2193", stop: "\u25a0" };
const STORE = "fleetjax-seat";

let facts = { actions: [], hold: true, verb: "move", interval: 0.1, resetTime: 1 };
let state = { mode: "free", robot: -1 };
const held = new Map(); // what is held, by what holds it: a key or a button
const buttons = new Map();
let noted; // the timer that takes a note away

const send = connect("/ws/operator", {
  open: () => claim(),
  hello: (message) => {
    facts = message;
    layPad();
  },
  seat: sit,
  taken: (message) => choose(message.reason, message.free),
  expired: () => stand("You were away for too long, so your seat is free again."),
  left: () => stand("You have left your seat."),
  waiting: (message) => {
    send({ type: "seen" });
    say(`You have a seat. The session starts when ${message.wanted} people are here; so far: ${message.people} of ${message.wanted}.`);
  },
  ping: () => send({ type: "seen" }),
  state: update,
  refused: (message) => note(message.reason),
  error: (message) => note(message.reason),
  over: () => {
    idle();
    say("The session is over. Thank you!");
    byId("leave").disabled = true;
  },
  replaced: () => {
    idle();
    say("Your seat is open in another window.");
    byId("leave").disabled = true;
  },
  closed: (done) => {
    if (done) return;
    idle();
    say("The connection is lost. Your seat is kept for a short while.");
  },
});

/** Ask for a seat: the one that this browser had, else the wish, else any. */
function claim(wish = Number(new URLSearchParams(location.search).get("seat") ?? 0) - 1) {
  const seat = Number.isInteger(wish) && wish >= 0 ? wish : -1;
  send({ type: "claim", key: localStorage.getItem(STORE) ?? "", seat });
}

function sit(message) {
  localStorage.setItem(STORE, message.key);
  write(byId("seat"), `Seat ${message.seat + 1}`);
  document.title = `Seat ${message.seat + 1} - fleetjax console`;
  byId("leave").disabled = false;
  byId("choices").hidden = true;
  say("You have a seat. No robot needs you yet.");
}

function stand(reason) {
  localStorage.removeItem(STORE);
  write(byId("seat"), "No seat");
  byId("leave").disabled = true;
  idle();
  choose(reason, null);
}

/** Offer free seats, or another try. */
function choose(reason, free) {
  say(reason.charAt(0).toUpperCase() + reason.slice(1));
  const offers = free?.length ? free.map((seat) => [`Take seat ${seat + 1}`, seat]) : [["Take a free seat", -1]];
  byId("choices").replaceChildren(...offers.map(([text, seat]) => {
    const button = make("button", text, { type: "button" });
    button.onclick = () => claim(seat);
    return button;
  }));
  byId("choices").hidden = false;
}

/** Say whose turn it is; screen readers hear it when it changes. */
function say(text) {
  write(byId("turn"), text);
}

/** Show a short note for a moment. */
function note(text) {
  write(byId("note"), text);
  clearTimeout(noted);
  noted = setTimeout(() => write(byId("note"), ""), 3000);
}

function idle() {
  letGo();
  show({ mode: "free", robot: -1 });
}

function update(message) {
  const sameHelp = message.robot === state.robot && message.since === state.since;
  if (!sameHelp) letGo(); // what is held was meant for another robot
  for (const button of buttons.values()) button.classList.remove("sent");
  show(message);
  if (message.mode === "free" && message.resets_begin >= 0)
    say(`Not your turn: some robots are stuck, but resets begin at timestep ${message.resets_begin}.`);
  else if (message.mode === "free") say("Not your turn: no robot needs you now.");
  else if (message.mode === "drive") say(`Your turn: ${facts.verb} robot ${message.robot}.`);
  else if (message.confirmed) say(`Robot ${message.robot} is being reset.`);
  else say(`Your turn: robot ${message.robot} is stuck. Reset it: press R, or the red button.`);
  if (facts.hold && held.size) act();
  else send({ type: "seen" });
}

function show(message) {
  state = message;
  byId("desk").dataset.mode = message.confirmed ? "resetting" : message.mode;
  const picture = byId("picture");
  if (message.picture) picture.src = message.picture;
  picture.hidden = !message.picture;
  picture.alt = message.picture ? `Robot ${message.robot} from above` : "";
  byId("nothing").hidden = !picture.hidden;
  for (const button of buttons.values()) button.disabled = message.mode !== "drive";
  byId("reset").disabled = message.mode !== "reset" || message.confirmed;
  write(byId("why"), message.why ?? "-");
  write(byId("bound"), boundText(message));
  write(byId("tick"), message.tick === undefined ? "-" : `${message.tick} of ${message.steps}`);
  showSignals(message.signals ?? []);
}

function boundText(message) {
  if (message.mode === "free") return "-";
  const time = (ticks) => `${ticks} timestep${ticks === 1 ? "" : "s"} (${(ticks * facts.interval).toFixed(1)} s)`;
  if (message.mode === "drive") return message.bound ? `at least ${time(message.bound)}` : "as long as it ranks high enough";
  return message.confirmed ? `${time(message.bound)} until it is reset` : `until you press R, then ${time(message.bound)}`;
}

/** Show each signal on a scale whose middle is its threshold, or 0 to 1 if it has none. */
function showSignals(signals) {
  const box = byId("signals");
  while (box.children.length > signals.length) box.lastChild.remove();
  while (box.children.length < signals.length) {
    const row = make("div", "", { class: "signal" });
    row.append(make("span"), make("div", "", { class: "scale", role: "meter" }), make("output"));
    row.children[1].append(make("span", ""));
    box.append(row);
  }
  signals.forEach((signal, i) => {
    const row = box.children[i];
    const limit = signal.threshold;
    const meter = row.children[1];
    const top = limit === null ? 1 : 2 * limit;
    write(row.firstChild, signal.name);
    meter.setAttribute("aria-label", signal.name);
    meter.setAttribute("aria-valuemax", Math.max(top, signal.value));
    meter.setAttribute("aria-valuenow", signal.value);
    meter.firstChild.style.width = `${100 * Math.min(1, signal.value / (top || 1e-9))}%`;
    const text = signal.value.toPrecision(2);
    write(row.lastChild, limit === null ? text : `${text}, threshold ${Number(limit.toPrecision(3))}`);
    row.classList.toggle("limited", limit !== null);
    row.classList.toggle("above", limit !== null && signal.value >= limit);
  });
}

// Acting

function act(names = [...new Set(held.values())]) {
  if (state.mode !== "drive" || !names.length) return;
  send({ type: "act", robot: state.robot, since: state.since, tick: state.tick, held: names });
  if (facts.hold) return;
  for (const [name, button] of buttons) button.classList.toggle("sent", names.includes(name)); // the last press counts
}

function press(holder, name) {
  if (state.mode !== "drive" || !facts.actions.includes(name)) return;
  if (facts.hold) {
    held.set(holder, name);
    act();
    buttons.get(name)?.classList.add("down");
  } else {
    act([name]);
  }
}

function release(holder, name) {
  held.delete(holder);
  buttons.get(name)?.classList.remove("down");
}

function letGo() {
  held.clear();
  for (const button of buttons.values()) button.classList.remove("down", "sent");
}

function reset() {
  if (state.mode === "reset" && !state.confirmed) send({ type: "reset", robot: state.robot, since: state.since });
}

function layPad() {
  buttons.clear();
  byId("pad").replaceChildren(...facts.actions.map((name) => {
    const button = make("button", SIGNS[name] ?? name, { type: "button", "data-name": name, "aria-label": `${facts.verb} ${name}` });
    if (name === "stop") button.setAttribute("aria-label", "stop");
    button.onpointerdown = (event) => {
      button.setPointerCapture(event.pointerId);
      press(`pointer ${event.pointerId}`, name);
    };
    button.onpointerup = button.onpointercancel = (event) => release(`pointer ${event.pointerId}`, name);
    button.onclick = (event) => { // by Enter or the space bar; pointers were heard already
      if (event.detail === 0) act([name]);
    };
    button.oncontextmenu = (event) => event.preventDefault();
    buttons.set(name, button);
    button.disabled = true;
    return button;
  }));
  write(byId("hint"), facts.hold
    ? "Hold arrow keys or W A S D; the space bar lets it coast to a stop. While you hold nothing, the robot acts by itself."
    : "Arrow keys or W A S D: one push per timestep, and the last press counts. While you press nothing, the robot acts by itself.");
}

addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const name = KEYS[event.code];
  if (event.code === "KeyR" && !event.repeat) reset();
  if (!name || (name === "stop" && event.target.closest?.("button, a"))) return;
  event.preventDefault();
  if (!event.repeat) press(event.code, name);
});
addEventListener("keyup", (event) => release(event.code, KEYS[event.code]));
addEventListener("blur", letGo);
byId("reset").onclick = reset;
byId("leave").onclick = () => send({ type: "leave" });
