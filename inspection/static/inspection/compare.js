// The difference of two scans of one region: blue gained, red lost, white unchanged.
import { colour, config, fail, fetchPicture, look } from "./drawing.js";

const map = document.querySelector("[data-difference]");
async function draw() {
  try {
    const picture = await fetchPicture(map.dataset.difference);
    const most = Math.max(Math.abs(picture.span[0]), Math.abs(picture.span[1]), 1);
    map.querySelector(".chart-wait")?.remove();
    await Plotly.newPlot(map, [{
      type: "heatmap", z: picture.z, x0: picture.x0, dx: picture.dx, y0: picture.y0, dy: picture.dy, zmin: -most, zmax: most,
      colorscale: "RdBu", reversescale: true, hoverongaps: false, colorbar: { title: { text: "µm", side: "top" }, thickness: 14, outlinewidth: 0 },
      hovertemplate: "%{x:.3f} mm along<br>%{y:.3f} mm across<br><b>%{z:.1f} µm</b><extra></extra>",
    }], look({
      plot_bgcolor: colour("--hatch-1"), margin: { l: 58, r: 8, t: 8, b: 46 },
      xaxis: { title: { text: "along the edge, mm" }, showgrid: false, zeroline: false, constrain: "domain" },
      yaxis: { title: { text: "across the bevel, mm" }, autorange: "reversed", showgrid: false, zeroline: false, scaleanchor: "x", constrain: "domain" },
    }), { ...config, doubleClick: "reset" });
    map.dataset.drawn = "difference";
  } catch (error) {
    fail(map, error);
  }
}
document.addEventListener("theme", draw);
draw();
