// What the page does by itself: it writes numbers down, tells the server what was shown, and hears keys.
// `wire` carries the newest state as JSON and, back, the number of the view that was drawn last; see play_page.py.
const state = JSON.parse(wire.text);
const put = (element, text) => { if (element && element.textContent !== text) element.textContent = text; };

document.documentElement.dataset.theme = state.theme;
document.body.classList.toggle("two", state.robots.length === 2);
document.body.classList.toggle("glazed", state.glass);
const message = document.getElementById("message");
put(message, state.message);
message.classList.toggle("waits", state.waits);
put(document.getElementById("rate"), state.rate);
put(document.getElementById("scene-told"), state.scene);
const sentence = document.getElementById("sentence");
sentence.hidden = !state.refused;
for (const id of ["bar", "scene", "stage"]) document.getElementById(id).hidden = Boolean(state.refused);
document.querySelector("footer").hidden = Boolean(state.refused);
if (state.refused && !sentence.textContent) {
  sentence.textContent = state.refused + ". ";
  const link = document.createElement("a");
  link.href = window.location.pathname;
  link.textContent = "Open the usual scene.";
  sentence.append(link);
}
state.robots.forEach((robot, number) => {
  const section = document.getElementById("robot" + number);
  for (const field of section.querySelectorAll("[data-field]")) put(field, robot[field.dataset.field]);
  section.classList.toggle("blind", robot.blind);
  section.classList.toggle("deaf", robot.deaf);
  section.querySelector(".alarm").classList.toggle("hit", robot.touching);
  document.querySelectorAll(".beta")[number].querySelectorAll("span").forEach((end, at) => put(end, robot.ends[at]));
});
const film = document.getElementById("film");
if (film.dataset.shown !== JSON.stringify(state.film)) {
  film.dataset.shown = JSON.stringify(state.film);
  film.textContent = state.film.told;
  for (const name of state.film.files) {
    const link = document.createElement("a");
    link.href = "films/" + name;
    link.download = name;
    link.textContent = name.split(".").pop().toUpperCase();
    film.append(" ", link);
  }
}
// What the page shows of itself stands in the link where it is not as usual, or where the link had said it.
window.playAsked = window.playAsked || new URLSearchParams(window.location.search);
const own = { theme: state.theme, zoom: state.zoom };
const usual = { theme: window.matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light", zoom: state.usual_zoom };
const kept = Object.keys(own).filter((key) => window.playAsked.has(key) || own[key] !== usual[key]);
const query = "?" + state.query + kept.map((key) => "&" + key + "=" + own[key]).join("");
if (!state.refused && window.location.search !== query) window.history.replaceState(null, "", query);

if (window.playKeys === undefined) {
  // Else who holds an obstacle for a moment, or has a slow machine, could not drag it: it would be a press.
  try {
    Bokeh.require("core/ui_gestures").UIGestures.press_threshold = 2 ** 31 - 1;
  } catch (error) {
    // Another Bokeh, which keeps its threshold elsewhere.
  }
  window.playKeys = 0;
  const isHandle = (at) => Boolean(at.classList && at.classList.contains("noUi-handle"));
  // noUiSlider keeps the ends that it was made with; here they change with the agent.
  window.addEventListener("keydown", (event) => {
    const path = event.composedPath();
    if (!isHandle(path[0]) || !["Home", "End"].includes(event.key)) return;
    const second = path.some((element) => element.classList && element.classList.contains("second"));
    const slider = second ? beta1 : beta0;
    slider.value = event.key === "Home" ? slider.start : slider.end;
    event.preventDefault();
    event.stopPropagation();
  }, { capture: true });
  // Who clicks means the drive with the next key, not what was clicked: only who tabs there works it by keys.
  window.addEventListener("click", (event) => {
    const at = event.composedPath().find((element) => element.matches && element.matches("button, summary"));
    if (at && event.detail > 0) at.blur();
  });
  window.addEventListener("keydown", (event) => {
    const at = event.composedPath()[0];
    const writes = at instanceof HTMLInputElement || at instanceof HTMLSelectElement;
    if (writes || (isHandle(at) && event.key.startsWith("Arrow"))) return;
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    // Space works what is focused, and who holds a key means one press.
    if (event.key === " " && at.matches && at.matches("button, summary")) return;
    if (event.repeat && [" ", "o"].includes(event.key.toLowerCase())) return event.preventDefault();
    const turned = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (turned) {
      const slider = event.shiftKey ? beta1 : beta0;
      if (!slider.disabled) {
        const span = slider.end - slider.start;
        slider.value = Math.min(slider.end, Math.max(slider.start, slider.value + turned * span / 20));
      }
    } else if ([" ", ".", "o", "a", "d"].includes(event.key.toLowerCase())) {
      window.playKeys += 1;
      wire.tags = [wire.tags[0] || 0, [event.key.toLowerCase(), window.playKeys]];
    } else return;
    event.preventDefault();
  });
}
// The figures are drawn in the frame that comes; what is asked for a frame later comes behind them.
window.requestAnimationFrame(() => window.setTimeout(() => { wire.tags = [state.number, wire.tags[1] || null]; }, 0));
