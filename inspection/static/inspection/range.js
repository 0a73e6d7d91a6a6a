// The range image of one scan: heat map in mm with the detail the window deserves, damage outlines, the two profiles
// through a point, and a 3D view on demand.
import { colour, config, fail, fetchPicture, look, unitWord } from "./drawing.js";

const panel = document.getElementById("range");
const map = panel.querySelector("[data-map]");
const wait = map.querySelector(".chart-wait");
const cuts = panel.querySelector("[data-cuts]");
const shapes = JSON.parse(document.getElementById("damage-shapes").textContent);
const rowMm = panel.dataset.rowUm / 1000;
const profileMm = panel.dataset.profileUm / 1000;
const rows = Number(panel.dataset.rows);
const profiles = Number(panel.dataset.profiles);
const whole = { x: [-profileMm / 2, (profiles - 0.5) * profileMm], y: [(rows - 0.5) * rowMm, -rowMm / 2] };
//: Cells along the longer side that a weak tablet still draws at once.
const CELLS = 600;
const CELLS_3D = 240;

let channel = "level";
let solid = false;
let point = null;
let latest = 0;

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
    const outline = damage.outline?.length
      ? damage.outline.map((points) => `M${points.map(([x, y]) => `${x},${y}`).join("L")}Z`).join("")
      : null;
    const { x0, x1, y0, y1 } = damage;
    return outline ? { type: "path", path: outline, line } : { type: "rect", x0, x1, y0, y1, line };
  });
}

const labels = () => shapes.map((damage) => ({
  x: damage.x1, y: damage.y0, text: `<b>${damage.number}</b>`, showarrow: false, xanchor: "left", yanchor: "bottom",
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
  xaxis: { title: { text: "along the edge, mm" }, range: whole.x, minallowed: whole.x[0], maxallowed: whole.x[1], showgrid: false, zeroline: false, constrain: "domain" },
  yaxis: { title: { text: "across the bevel, mm" }, range: whole.y, minallowed: whole.y[1], maxallowed: whole.y[0], showgrid: false, zeroline: false, scaleanchor: "x", constrain: "domain" },
});

async function draw() {
  const mine = ++latest;
  wait.hidden = false;
  try {
    const picture = await fetchPicture(address(solid ? CELLS_3D : CELLS));
    if (mine !== latest) return;
    const unit = unitWord(picture.unit);
    const bar = { title: { text: unit, side: "top" }, thickness: 14, outlinewidth: 0 };
    const colorscale = channel === "level" || channel === "height" ? "Viridis" : "Cividis";
    const common = { z: picture.z, x0: picture.x0, dx: picture.dx, y0: picture.y0, dy: picture.dy, colorscale, colorbar: bar };
    const { zmin, zmax } = scaleOf(picture);
    wait.remove();
    if (solid) {
      const axis = (index, count, step, start) => Array.from({ length: count }, (_, i) => start + i * step);
      Plotly.purge(map);
      await Plotly.newPlot(map, [{
        type: "surface", z: picture.z.map((row) => Array.from(row)), x: axis(0, picture.columns, picture.dx, picture.x0),
        y: axis(1, picture.rows, picture.dy, picture.y0), colorscale, cmin: zmin, cmax: zmax, colorbar: bar,
        hovertemplate: `%{x:.3f} mm, %{y:.3f} mm<br>%{z:.1f} ${unit}<extra></extra>`,
      }], look({
        margin: { l: 0, r: 0, t: 0, b: 0 },
        scene: {
          xaxis: { title: { text: "along, mm" } }, yaxis: { title: { text: "across, mm" }, autorange: "reversed" }, zaxis: { title: { text: unit } },
          aspectmode: "manual", aspectratio: aspect(picture), camera: { eye: { x: 0.9, y: -1.3, z: 0.9 } },
        },
      }), config);
      return;
    }
    await Plotly.newPlot(map, [{
      type: "heatmap", ...common, zmin, zmax, zsmooth: false, hoverongaps: false,
      hovertemplate: `%{x:.3f} mm along<br>%{y:.3f} mm across<br><b>%{z:.1f} ${unit}</b><extra></extra>`,
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
  const span = (range, step, count) => {
    const [low, high] = [Math.min(...range) / step, Math.max(...range) / step];
    return [Math.max(0, Math.floor(low)), Math.min(count, Math.ceil(high) + 1)];
  };
  const window = { rows: span(y, rowMm, rows), cols: span(x, profileMm, profiles) };
  if (window.rows[0] >= window.rows[1] || window.cols[0] >= window.cols[1]) return;
  try {
    const picture = await fetchPicture(address(CELLS, window));
    if (mine !== latest || solid) return;
    const { zmin, zmax } = scaleOf(picture);
    await Plotly.restyle(map, { z: [picture.z], x0: picture.x0, dx: picture.dx, y0: picture.y0, dy: picture.dy, zmin, zmax });
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
  const { x, y } = event.points[0];
  const row = Math.min(rows - 1, Math.max(0, Math.round(y / rowMm)));
  const profile = Math.min(profiles - 1, Math.max(0, Math.round(x / profileMm)));
  point = { x: profile * profileMm, y: row * rowMm };
  Plotly.relayout(map, { shapes: [...damageShapes(), ...crosshair()] });
  const query = new URLSearchParams({ row, col: profile, channel, result: panel.dataset.result });
  const answer = await fetch(`${panel.dataset.cut}?${query}`);
  const cut = await answer.json();
  cuts.hidden = false;
  const words = panel.querySelector("[data-cut-words]");
  if (!answer.ok) { words.textContent = cut.detail; return; }
  words.textContent = `Profiles through row ${row} (${point.y.toFixed(3)} mm across) and profile ${profile} (${point.x.toFixed(3)} mm along)`;
  profileChart(panel.querySelector("[data-along]"), cut.along, "along the edge, mm", point.x, cut.unit);
  profileChart(panel.querySelector("[data-across]"), cut.across, "across the bevel, mm", point.y, cut.unit);
}

function profileChart(element, line, title, here, unit) {
  const trace = {
    type: "scatter", mode: "lines", y: line.values, x0: 0, dx: line.step_mm, line: { color: colour("--accent"), width: 1.5 },
    connectgaps: false, hovertemplate: `%{x:.3f} mm: %{y:.1f} ${unitWord(unit)}<extra></extra>`,
  };
  const mark = { type: "line", x0: here, x1: here, yref: "paper", y0: 0, y1: 1, line: { color: colour("--ink"), width: 1, dash: "dot" } };
  Plotly.react(element, [trace], look({
    shapes: [mark], margin: { l: 52, r: 8, t: 6, b: 42 }, xaxis: { title: { text: title } }, yaxis: { title: { text: unitWord(unit) } },
  }), config);
}

panel.querySelector("[data-channel]").addEventListener("change", (event) => { channel = event.target.value; draw(); });
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
    show(Math.max(whole.x[0], damage.x0 - room), Math.min(whole.x[1], damage.x1 + room),
      Math.max(whole.y[1], damage.y0 - room), Math.min(whole.y[0], damage.y1 + room));
    panel.scrollIntoView({ block: "start" });
  };
  row.addEventListener("click", go);
  row.addEventListener("keydown", (event) => { if (event.key === "Enter") go(); });
}
document.addEventListener("theme", () => draw());
draw();
