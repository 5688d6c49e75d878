"use strict";
// The blobs are gzip in base64: the library, and what is drawn.
async function unpacked(id) {
  const text = document.getElementById(id).textContent.trim();
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).text();
}

async function draw() {
  const library = document.createElement("script");
  library.textContent = await unpacked("library");
  document.head.append(library);
  const content = JSON.parse(await unpacked("content"));
  const coarse = matchMedia("(pointer: coarse)").matches;
  const plots = [];
  for (const { id, data, layout, follows } of content) {
    const div = document.getElementById(id);
    // A finger on a plot scrolls the page; the buttons zoom.
    layout.dragmode = coarse ? false : "zoom";
    await Plotly.newPlot(div, data, layout, {
      responsive: true, displaylogo: false,
      modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"],
    });
    plots.push({ div, follows });
  }
  let moving = false;
  for (const { div, follows } of plots.filter((one) => one.follows)) {
    div.on("plotly_relayout", async (change) => {
      if (moving || !Object.keys(change).some((key) => key.startsWith("xaxis"))) return;
      moving = true;
      const range = [...div.layout.xaxis.range];
      for (const other of plots.filter((one) => one.follows && one.div !== div))
        await Plotly.relayout(other.div, { "xaxis.range": [...range] });
      moving = false;
      document.body.dataset.range = range.join(" ");
    });
  }
  for (const button of document.querySelectorAll(".keys button")) {
    button.disabled = false;
    button.addEventListener("click", async () => {
      const shown = button.getAttribute("aria-pressed") !== "true";
      button.setAttribute("aria-pressed", String(shown));
      for (const { div } of plots) {
        const own = div.data.flatMap((one, place) => one.legendgroup === button.dataset.group ? [place] : []);
        if (own.length) await Plotly.restyle(div, { visible: shown }, own);
      }
    });
  }
  const paper = 690;
  addEventListener("beforeprint", () => {
    for (const { div } of plots) Plotly.relayout(div, { width: paper, height: Math.max(190, div.offsetHeight - 30) });
  });
  addEventListener("afterprint", () => {
    for (const { div } of plots) Plotly.relayout(div, { width: null, height: null, autosize: true });
  });
  document.body.dataset.drawn = String(plots.length);
}

draw().catch((error) => {
  const failure = document.getElementById("failure");
  failure.textContent = `The figures cannot be drawn: ${error.message}.`;
});
