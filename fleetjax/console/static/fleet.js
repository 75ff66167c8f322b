// Everybody's view: four curves, who helps whom, and all robots.

import { byId, connect, make, write } from "./common.js";

const PANELS = ["Cumulative successes", "Cumulative violations", "Cumulative idle timesteps", "Return on human effort"];
const SVG = "http://www.w3.org/2000/svg";
const [WIDTH, HEIGHT] = [240, 90];
let facts = { steps: 1, robots: 0, seats: 0 };

connect("/ws/fleet", {
  hello: (message) => {
    facts = message;
    write(byId("headline"), message.headline);
    layCurves();
    lay(byId("seats"), message.seats, () => make("li"));
    lay(byId("robots"), message.robots, makeRobot);
  },
  waiting: (message) => say(`waiting for people: ${message.people} of ${message.wanted} are here`),
  fleet: (message) => {
    const people = message.people === 1 ? "1 person" : `${message.people} people`;
    say(`timestep ${message.tick} of ${facts.steps}, ${people} at work`);
    drawCurves(message.places, message.curves);
    message.seats.forEach(showSeat);
    message.robots.forEach((robot, i) => showRobot(robot, i, message));
  },
  over: (message) => say(`the session is over after ${message.tick} timesteps`),
});

function say(text) {
  write(byId("state"), text.charAt(0).toUpperCase() + text.slice(1));
}

/** Fill a list with as many children as there are things. */
function lay(list, number, build) {
  list.replaceChildren(...Array.from({ length: number }, (_, i) => build(i)));
}

function layCurves() {
  lay(byId("curves"), PANELS.length, (i) => {
    const figure = make("figure");
    const title = make("figcaption", PANELS[i]);
    title.append(make("strong", "0"));
    const drawing = document.createElementNS(SVG, "svg");
    drawing.setAttribute("viewBox", `0 0 ${WIDTH} ${HEIGHT}`);
    drawing.setAttribute("preserveAspectRatio", "none");
    drawing.setAttribute("aria-hidden", "true"); // the number beside the title says it
    drawing.append(document.createElementNS(SVG, "polyline"));
    figure.append(title, drawing);
    return figure;
  });
}

function drawCurves(places, curves) {
  curves.forEach((heights, i) => {
    const [title, drawing] = byId("curves").children[i].children;
    const last = heights.at(-1);
    write(title.lastChild, i === 3 ? last.toFixed(2) : last.toLocaleString("en"));
    const top = Math.max(...heights, i === 3 ? 0.01 : 1);
    const across = Math.max(1, places.at(-1));
    const points = heights.map((y, k) => `${((places[k] / across) * WIDTH).toFixed(1)},${(HEIGHT - 2 - (y / top) * (HEIGHT - 6)).toFixed(1)}`);
    drawing.firstChild.setAttribute("points", points.join(" "));
  });
}

function showSeat(seat, i) {
  const helps = seat.waits ? `robot ${seat.robot} waits for R` : `${seat.resets ? "resets" : "helps"} robot ${seat.robot}`;
  const does = seat.robot < 0 ? "free" : helps;
  const item = byId("seats").children[i];
  write(item, `Seat ${i + 1} (${seat.who}): ${seat.who === "empty" ? "nobody there" : does}`);
  item.dataset.who = seat.who;
  item.dataset.busy = seat.robot >= 0;
}

function makeRobot(i) {
  const item = make("li");
  const picture = make("img", "", { alt: "", hidden: "" });
  item.append(picture, make("strong", `Robot ${i}`), make("span", ""));
  return item;
}

function showRobot(robot, i, message) {
  const item = byId("robots").children[i];
  const [picture, , text] = item.children;
  const data = message.pictures[i];
  if (data) picture.src = data;
  picture.hidden = !data;
  const helped = robot.helper >= 0;
  const waiting = message.resets_begin < 0 ? "stuck, waits" : `stuck; resets begin at timestep ${message.resets_begin}`;
  const alone = robot.violation ? waiting : "by itself";
  const waits = helped && message.seats[robot.helper].waits;
  const help = waits ? `waits for R from seat ${robot.helper + 1}` : `seat ${robot.helper + 1} ${robot.violation ? "resets" : "helps"}`;
  const does = helped ? help : alone;
  write(text, does);
  item.dataset.state = robot.violation ? "violation" : helped ? "helped" : "moving";
  item.title = `uncertainty ${robot.uncertainty}, risk ${robot.risk}`;
}
