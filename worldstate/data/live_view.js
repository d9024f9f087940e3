// A live run: a websocket delivers the hops, and the page draws the last minute four times a second.
const MOST = 600, DRAWN_EVERY_MS = 250;
const health = put(at("title").parentNode, "p", { id: "health", role: "status" });
const cameras = put(at("street").parentNode, "div", { id: "cameras" }), views = {};
let received = [], following = true, waits = false;

function follow(on) {
  following = on;
  playing = on ? 1 : 0;
  at("play").textContent = on ? "Pause" : "Follow";
  if (on && rows) show(last);
}
play = follow;
go = (k) => {
  follow(false);
  show(k);
};
const showSnapshot = show;
show = (k) => {
  showSnapshot(k);
  drawHealth(rows[shown]);
  drawCameras(rows[shown]);
};
function drawHealth({ live, sensors, heard, cues }) {
  health.replaceChildren();
  const chip = (text, bad) => put(health, "span", { class: bad ? "chip bad" : "chip" }, text);
  for (const [name, condition, reason] of sensors) {
    const share = cues.length && name in heard ? `, detects ${Math.round(100 * heard[name])} % of hidden vehicles` : "";
    const bad = condition !== "working" || heard[name] < 0.5;
    chip(`${name}: ${condition}${reason ? ` (${reason})` : ""}${share}`, bad);
  }
  chip(`${Math.round(1000 * live.latency_s)} ms behind the sound`, live.latency_s > 0.5);
  if (live.overruns) chip(`${live.overruns} overruns, ${live.lost_s.toFixed(2)} s of sound lost`, true);
}
// The boxes of each camera, left on the left, with their true angular width; a parked one is hollow.
function drawCameras(row) {
  Object.assign(views, row.cameras);
  cameras.replaceChildren();
  for (const [name, { low, high }] of Object.entries(views)) {
    const seen = row.cameras[name], found = seen ? seen.boxes.length || "no" : "no image, no";
    put(cameras, "h2", {}, `${name}: ${found} ${found === 1 ? "box" : "boxes"}`);
    const svg = put(cameras, "svg", { height: 64, role: "img", "aria-label": name }), width = svg.clientWidth;
    const x = (azimuth) => ((high - azimuth) / (high - low)) * width;
    put(svg, "rect", { width, height: 46, fill: color(seen ? "panel" : "rule") });
    for (const one of seen?.boxes ?? []) {
      const from = x(one.azimuth + one.width / 2), to = x(one.azimuth - one.width / 2), blue = color("view");
      const fill = one.moving ? blue : "none";
      put(svg, "rect", { x: from, y: 18, width: Math.max(to - from, 2), height: 27, fill, stroke: blue });
      const text = `${one.label} ${short(one.score)}${one.moving ? "" : ", parked"}`, half = 3.2 * text.length;
      const middle = Math.min(Math.max((from + to) / 2, half), width - half);
      put(svg, "text", { x: middle, y: 13, "text-anchor": "middle" }, text);
    }
    for (const [azimuth, anchor] of [[high, "start"], [0, "middle"], [low, "end"]])
      if (azimuth <= high && azimuth >= low)
        put(svg, "text", { class: "muted", x: x(azimuth), y: 60, "text-anchor": anchor }, `${minus(azimuth.toFixed(0))}\u00b0`);
  }
}
function drawReceived() {
  waits = false;
  if (document.hidden || !received.length) return;
  const t = rows?.[shown].t;
  take(received);
  shown = following || t === undefined ? last : Math.max(rows.findIndex((row) => row.t >= t), 0);
  drawCharts();
}
function receive(more) {
  received = received.concat(more).slice(-MOST);
  if (!waits) setTimeout(drawReceived, DRAWN_EVERY_MS);
  waits = true;
}
document.addEventListener("visibilitychange", drawReceived);
follow(true);
at("sentence").textContent = "The first snapshot needs one second of sound.";
const feed = new WebSocket(`ws://${location.host}@states@`);
feed.onmessage = ({ data }) => receive(JSON.parse(data));
// The page does not reconnect: a browser reports each attempt without a server as an error.
feed.onclose = () => put(at("remarks"), "p", { class: "remark" }, "The run has ended. Reload this page to show another run.");
