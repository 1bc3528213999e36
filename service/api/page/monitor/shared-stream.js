/** Runs as a SharedWorker, one for all pages of a browser: a browser opens six connections to a host, and a caller may have five streams. */
import { EventStream } from "./event-stream.js";

const stream = new EventStream();

addEventListener("connect", (event) => {
  const [port] = /** @type {MessageEvent} */ (event).ports;
  const listener = (/** @type {import("./event-stream.js").Told} */ told) => port.postMessage(told);
  stream.join(listener);
  port.onmessage = ({ data }) => stream[/** @type {import("./event-stream.js").Order} */ (data.order)](listener, data.place);
});
