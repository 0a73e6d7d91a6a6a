// The range image of one scan: heat map in mm with the detail the window deserves, damage outlines, the two profiles
// through a point, and a 3D view on demand.
import { colour, config, fail, fetchPicture, look, unitWord } from "./drawing.js";

const panel = document.getElementById("range");
const map = panel.querySelector("[data-map]");
const wait = map.querySelector(".chart-wait");
const cuts = panel.querySelector("[data-cuts]");
const rowMm = panel.dataset.rowUm / 1000;
const profileMm = panel.dataset.profileUm / 1000;
const rows = Number(panel.dataset.rows);
const profiles = Number(panel.dataset.profiles);
// "Along" is the scan and the edge, "across" the laser line. An image much longer across is drawn lying on its side.
// Positions along the edge count from the tool's datum, as in every table; the image begins where its region does.
const startMm = Number(panel.dataset.startMm);
const along = { title: "along the edge, mm", step: profileMm, count: profiles, start: startMm, low: startMm - profileMm / 2, high: startMm + (profiles - 0.5) * profileMm };
const across = { title: "across the bevel, mm", step: rowMm, count: rows, start: 0, low: -rowMm / 2, high: (rows - 0.5) * rowMm };
const turned = across.high - across.low > 1.3 * (along.high - along.low);
const [flat, upright] = turned ? [across, along] : [along, across];
const whole = { x: [flat.low, flat.high], y: [upright.high, upright.low] };
const fit = () => {
  const room = map.clientWidth - 150;
  map.style.height = `${Math.min(640, Math.max(280, (room * (upright.high - upright.low)) / (flat.high - flat.low) + 70))}px`;
};
/** A picture as plotly takes it, turned if the map is. */
function laid({ z, x0, y0, dx, dy }) {
  if (!turned) return { z, x0: x0 + startMm, dx, y0, dy };
  const lying = Array.from(z[0], (_, column) => Float32Array.from(z, (row) => row[column]));
  return { z: lying, x0: y0, dx: dy, y0: x0 + startMm, dy: dx };
}
/** A point given as (along, across) in plot coordinates. */
const place = (a, b) => (turned ? [b, a] : [a, b]);
//: Cells along the longer side that a weak tablet still draws at once.
const CELLS = 600;
const CELLS_3D = 240;

const shapes = JSON.parse(document.getElementById("damage-shapes").textContent).map((damage) => ({
  ...damage, x0: damage.x0 + startMm, x1: damage.x1 + startMm,
  outline: damage.outline.map((line) => line.map(([x, y]) => [x + startMm, y])),
}));

let channel = "level";
let solid = false;
let point = null;
let latest = 0;

//: Channels from 0 to 1, and what stands at their colour bar and axis in place of a unit.
const BAR = { confidence: "confidence, 0 to 1" };
const barTitle = (unit) => (BAR[channel] ? { text: BAR[channel], side: "right" } : { text: unitWord(unit), side: "top" });
const value = (name, unit) => `%{${name}:.${BAR[channel] ? 2 : 1}f} ${BAR[channel] ? "" : unitWord(unit)}`;

const address = (most, window) => {
  const query = new URLSearchParams({ channel, max: most, result: panel.dataset.result });
  if (window) {
    query.set("rows", `${window.rows[0]}:${window.rows[1]}`);
    query.set("cols", `${window.cols[0]}:${window.cols[1]}`);
  }
  return `${panel.dataset.range}?${query}`;
};

function scaleOf(picture) {
  const stretch = panel.querySelector("[data-stretch]").checked;
  if (stretch || channel !== "level") return { zmin: picture.span[0], zmax: picture.span[1] };
  const fixed = Number(panel.dataset.fixed);
  return { zmin: -fixed, zmax: fixed / 3 };
}

function damageShapes() {
  return shapes.map((damage) => {
    const line = { color: "#e4572e", width: 2 };
    const outline = damage.outline.length
      ? damage.outline.map((points) => `M${points.map(([x, y]) => place(x, y).join(",")).join("L")}Z`).join("")
      : null;
    const [x0, y0] = place(damage.x0, damage.y0);
    const [x1, y1] = place(damage.x1, damage.y1);
    return outline ? { type: "path", path: outline, line } : { type: "rect", x0, x1, y0, y1, line };
  });
}

const labels = () => shapes.map((damage) => ({
  x: place(damage.x1, damage.y1)[0], y: place(damage.x0, damage.y0)[1], text: `<b>${damage.number}</b>`, showarrow: false, xanchor: "left", yanchor: "bottom",
  font: { color: "#fff", size: 14 }, bgcolor: "#c2401b", borderpad: 2,
}));

function crosshair() {
  if (!point) return [];
  const line = { color: colour("--ink"), width: 1, dash: "dot" };
  return [
    { type: "line", x0: whole.x[0], x1: whole.x[1], y0: point.y, y1: point.y, line },
    { type: "line", y0: whole.y[0], y1: whole.y[1], x0: point.x, x1: point.x, line },
  ];
}

const layout = () => look({
  // plot_bgcolor is what shows where nothing was measured; app.css hatches it.
  plot_bgcolor: colour("--hatch-1"),
  shapes: [...damageShapes(), ...crosshair()],
  annotations: labels(),
  uirevision: "stay",
  dragmode: "zoom",
  margin: { l: 58, r: 8, t: 8, b: 46 },
  xaxis: { title: { text: flat.title }, range: whole.x, minallowed: whole.x[0], maxallowed: whole.x[1], showgrid: false, zeroline: false, constrain: "domain" },
  yaxis: { title: { text: upright.title }, range: whole.y, minallowed: whole.y[1], maxallowed: whole.y[0], showgrid: false, zeroline: false, scaleanchor: "x", constrain: "domain" },
});

async function draw() {
  const mine = ++latest;
  wait.hidden = false;
  try {
    const picture = await fetchPicture(address(solid ? CELLS_3D : CELLS));
    if (mine !== latest) return;
    const title = barTitle(picture.unit);
    const bar = { title, thickness: 14, outlinewidth: 0 };
    const colorscale = channel === "level" || channel === "height" ? "Viridis" : "Cividis";
    const common = { ...laid(picture), colorscale, colorbar: bar };
    const { zmin, zmax } = scaleOf(picture);
    wait.remove();
    fit();
    if (solid) {
      map.style.height = "480px";
      const axis = (index, count, step, start) => Array.from({ length: count }, (_, i) => start + i * step);
      Plotly.purge(map);
      await Plotly.newPlot(map, [{
        type: "surface", z: picture.z.map((row) => Array.from(row)), x: axis(0, picture.columns, picture.dx, picture.x0 + startMm),
        y: axis(1, picture.rows, picture.dy, picture.y0), colorscale, cmin: zmin, cmax: zmax, colorbar: bar,
        hovertemplate: `%{x:.3f} mm, %{y:.3f} mm<br>${value("z", picture.unit)}<extra></extra>`,
      }], look({
        margin: { l: 0, r: 0, t: 0, b: 0 },
        scene: {
          xaxis: { title: { text: "along, mm" } }, yaxis: { title: { text: "across, mm" }, autorange: "reversed" }, zaxis: { title: { text: title.text } },
          aspectmode: "manual", aspectratio: aspect(picture), camera: { eye: { x: 0.9, y: -1.3, z: 0.9 } },
        },
      }), config);
      return;
    }
    await Plotly.newPlot(map, [{
      type: "heatmap", ...common, zmin, zmax, zsmooth: false, hoverongaps: false,
      hovertemplate: `${flat.title.split(" ")[0]} %{x:.3f} mm<br>${upright.title.split(" ")[0]} %{y:.3f} mm<br><b>${value("z", picture.unit)}</b><extra></extra>`,
    }], layout(), config);
    map.removeAllListeners?.("plotly_relayout");
    map.on("plotly_relayout", zoomed);
    map.on("plotly_click", clicked);
    map.on("plotly_doubleclick", reset);
    panel.dataset.drawn = channel;
  } catch (error) {
    fail(map, error);
  }
}

function aspect(picture) {
  const [x, y] = [picture.columns * picture.dx, picture.rows * picture.dy];
  const longest = Math.max(x, y);
  return { x: x / longest, y: y / longest, z: 0.35 };
}

// After a zoom the window is fetched again at the resolution it deserves.
let soon = null;
function zoomed(change) {
  if (!Object.keys(change).some((key) => key.includes("range"))) return;
  clearTimeout(soon);
  soon = setTimeout(refine, 150);
}

async function refine() {
  const mine = ++latest;
  const [x, y] = [map.layout.xaxis.range, map.layout.yaxis.range];
  const span = (range, axis) => {
    const [low, high] = [Math.min(...range), Math.max(...range)].map((mm) => (mm - axis.start) / axis.step);
    return [Math.max(0, Math.floor(low)), Math.min(axis.count, Math.ceil(high) + 1)];
  };
  const [cols, rowSpan] = place(span(x, flat), span(y, upright));
  const window = { rows: rowSpan, cols };
  if (window.rows[0] >= window.rows[1] || window.cols[0] >= window.cols[1]) return;
  try {
    const picture = await fetchPicture(address(CELLS, window));
    if (mine !== latest || solid) return;
    const { zmin, zmax } = scaleOf(picture);
    await Plotly.restyle(map, { ...laid(picture), z: [laid(picture).z], zmin, zmax });
  } catch (error) {
    panel.querySelector("[data-cut-words]").textContent = error.message;
  }
}

function show(x0, x1, y0, y1) {
  Plotly.relayout(map, { "xaxis.range": [x0, x1], "yaxis.range": [y1, y0] });
}

function reset() {
  if (!solid) Plotly.relayout(map, { "xaxis.range": whole.x, "yaxis.range": whole.y });
}

async function clicked(event) {
  const [x, y] = place(event.points[0].x, event.points[0].y);  // turning twice is not turning
  const row = Math.min(rows - 1, Math.max(0, Math.round(y / rowMm)));
  const profile = Math.min(profiles - 1, Math.max(0, Math.round((x - startMm) / profileMm)));
  const at = { along: startMm + profile * profileMm, across: row * rowMm };
  const [x1, y1] = place(at.along, at.across);
  point = { x: x1, y: y1, ...at };
  Plotly.relayout(map, { shapes: [...damageShapes(), ...crosshair()] });
  const query = new URLSearchParams({ row, col: profile, channel, result: panel.dataset.result });
  const answer = await fetch(`${panel.dataset.cut}?${query}`);
  const cut = await answer.json();
  cuts.hidden = false;
  const words = panel.querySelector("[data-cut-words]");
  if (!answer.ok) { words.textContent = cut.detail; return; }
  words.textContent = `Profiles through row ${row} (${point.across.toFixed(3)} mm across) and profile ${profile} (${point.along.toFixed(3)} mm along)`;
  profileChart(panel.querySelector("[data-along]"), cut.along, along, point.along, cut.unit);
  profileChart(panel.querySelector("[data-across]"), cut.across, across, point.across, cut.unit);
}

function profileChart(element, line, axis, here, unit) {
  const trace = {
    type: "scatter", mode: "lines", y: line.values, x0: axis.start, dx: line.step_mm, line: { color: colour("--accent"), width: 1.5 },
    connectgaps: false, hovertemplate: `%{x:.3f} mm: ${value("y", unit)}<extra></extra>`,
  };
  const mark = { type: "line", x0: here, x1: here, yref: "paper", y0: 0, y1: 1, line: { color: colour("--ink"), width: 1, dash: "dot" } };
  Plotly.react(element, [trace], look({
    shapes: [mark], margin: { l: 52, r: 8, t: 6, b: 42 }, xaxis: { title: { text: axis.title } }, yaxis: { title: { text: barTitle(unit).text }, ...(BAR[channel] && { range: [0, 1.05] }) },
  }), config);
}

panel.querySelector("[data-channel]").addEventListener("change", (event) => {
  channel = event.target.value;
  panel.querySelector("[data-stretch]").disabled = channel !== "level";  // only the level has a fixed scale to choose
  draw();
});
panel.querySelector("[data-stretch]").addEventListener("change", () => draw());
panel.querySelector("[data-reset]").addEventListener("click", () => { point = null; if (solid) toggle(); else draw(); });
const button = panel.querySelector("[data-3d]");
function toggle() {
  solid = !solid;
  button.textContent = solid ? "Map" : "3D";
  Plotly.purge(map);
  draw();
}
button.addEventListener("click", toggle);

for (const row of document.querySelectorAll("tr[data-damage]")) {
  const go = () => {
    const damage = shapes.find((one) => one.number === Number(row.dataset.damage));
    if (!damage || solid) return;
    for (const other of document.querySelectorAll("tr[data-damage]")) other.classList.toggle("chosen", other === row);
    const room = 0.35 * Math.max(damage.x1 - damage.x0, damage.y1 - damage.y0) + 0.1;
    const [x0, y0] = place(damage.x0 - room, damage.y0 - room);
    const [x1, y1] = place(damage.x1 + room, damage.y1 + room);
    show(Math.max(flat.low, x0), Math.min(flat.high, x1), Math.max(upright.low, y0), Math.min(upright.high, y1));
    panel.scrollIntoView({ block: "start" });
  };
  row.addEventListener("click", go);
  row.addEventListener("keydown", (event) => { if (event.key === "Enter") go(); });
}
document.addEventListener("theme", () => draw());
fit();
draw();
