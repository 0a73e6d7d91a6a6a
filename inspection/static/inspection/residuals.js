// Residuals of a calibration line: what the line does not explain, by height.
import { colour, config, look } from "./drawing.js";

const chart = document.querySelector("[data-residuals]");
const data = JSON.parse(document.getElementById("residual-data").textContent);
function draw() {
  const stem = { color: colour("--line-strong"), width: 2 };
  Plotly.react(chart, [{
    type: "scatter", mode: "markers", x: data.height_mm, y: data.residual_um, customdata: data.column_px,
    marker: { size: 10, color: colour("--accent") },
    hovertemplate: "%{x:.3f} mm at column %{customdata:.2f}<br><b>%{y:.1f} µm</b><extra></extra>",
  }], look({
    shapes: data.height_mm.map((x, i) => ({ type: "line", x0: x, x1: x, y0: 0, y1: data.residual_um[i], line: stem, layer: "below" })),
    xaxis: { title: { text: "gauge height, mm" } }, yaxis: { title: { text: "residual, µm" }, zeroline: true, zerolinewidth: 2 },
  }), config);
}
document.addEventListener("theme", draw);
draw();
