// The server has ended, or is out of reach: the page says so, and opens the scene anew once somebody answers.
// Bokeh's own way back would show the old page's figures to a drive that does not know them.
const message = document.getElementById("message");
message.classList.remove("waits");
message.textContent =
  "The server does not answer: it was ended, or is out of reach. This scene opens anew as soon as it answers.";
const again = () => window.setTimeout(ask, 2000);
const ask = () => {
  fetch("static/js/bokeh.min.js", { method: "HEAD", cache: "no-store" })
    .then((answer) => (answer.ok ? window.location.reload() : again()), again);
};
again();
