import { byId, connect, write } from "./common.js";

connect("/ws/operator", {
  hello: (facts) => write(byId("headline"), facts.headline),
});
