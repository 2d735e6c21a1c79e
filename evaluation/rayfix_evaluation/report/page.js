(() => {
  const root = document.documentElement;
  const shown = [];
  const ink = () => getComputedStyle(root).getPropertyValue("--ink").trim();
  const draw = (place) => {
    const figure = JSON.parse(document.getElementById(place.dataset.figure).textContent);
    figure.layout.font = { color: ink(), family: "system-ui, sans-serif", size: 12 };
    Plotly.newPlot(place, figure.data, figure.layout, { responsive: true, displaylogo: false });
    shown.push(place);
  };
  // A browser has few WebGL contexts: pictures are drawn when they come into sight.
  const sight = new IntersectionObserver((entries) => {
    for (const entry of entries) {
      if (entry.isIntersecting) { sight.unobserve(entry.target); draw(entry.target); }
    }
  }, { rootMargin: "300px" });
  document.querySelectorAll(".space").forEach((place) => sight.observe(place));
  const recolour = () => shown.forEach((place) => Plotly.relayout(place, { "font.color": ink() }));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", recolour);
  document.getElementById("scheme").addEventListener("click", () => {
    const dark = root.dataset.scheme ? root.dataset.scheme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
    root.dataset.scheme = dark ? "light" : "dark";
    recolour();
  });
})();
