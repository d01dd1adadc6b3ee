"use strict";

/* Pictures enlarge on a click, sliders uncover what was before, and orbits turn. */
const enlarged = document.querySelector("#enlarged");
function enlarge(image) {
  const copy = enlarged.querySelector("img");
  copy.src = image.src;
  copy.alt = image.alt;
  enlarged.querySelector("figcaption").textContent = image.alt;
  enlarged.showModal();
}
for (const image of document.querySelectorAll("main figure > img:not(.turned)")) {
  image.tabIndex = 0;
  image.addEventListener("click", () => enlarge(image));
  image.addEventListener("keydown", (event) => event.key === "Enter" && enlarge(image));
}
enlarged.addEventListener("click", () => enlarged.close());

for (const slider of document.querySelectorAll(".slider")) {
  const [before, after] = slider.querySelectorAll("img"), range = slider.querySelector("input");
  const show = () => slider.style.setProperty("--cut", `${range.value}%`);
  range.addEventListener("input", show);
  show();
  for (const button of document.querySelectorAll(".views button")) {
    button.addEventListener("click", () => {
      const [first, second] = JSON.parse(button.dataset.pictures);
      before.src = document.querySelector(`#${first}`).src;
      after.src = document.querySelector(`#${second}`).src;
      for (const other of button.parentElement.children) {
        other.setAttribute("aria-pressed", other === button);
      }
    });
  }
}

for (const orbit of document.querySelectorAll(".orbit")) {
  const frames = JSON.parse(orbit.querySelector("script").textContent);
  const images = orbit.querySelectorAll(".turned"), range = orbit.querySelector("input");
  const play = orbit.querySelector("button");
  let timer = 0, from = null;
  const show = (number) => {
    const k = ((Math.round(number) % frames[0].length) + frames[0].length) % frames[0].length;
    range.value = k;
    images.forEach((image, side) => { image.src = frames[side][k]; });
  };
  const stop = () => {
    clearInterval(timer);
    timer = 0;
    play.textContent = "Play";
  };
  play.addEventListener("click", () => {
    if (timer) return stop();
    play.textContent = "Stop";
    timer = setInterval(() => show(Number(range.value) + 1), 100);
  });
  range.addEventListener("input", () => {
    stop();
    show(Number(range.value));
  });
  for (const image of images) {
    image.draggable = false;
    image.addEventListener("pointerdown", (event) => {
      stop();
      image.setPointerCapture(event.pointerId);
      from = [event.clientX, Number(range.value)];
    });
    image.addEventListener("pointermove", (event) => {
      if (from) show(from[1] + ((event.clientX - from[0]) / image.clientWidth) * frames[0].length);
    });
    image.addEventListener("pointerup", (event) => {
      if (from && Math.abs(event.clientX - from[0]) < 3) enlarge(image);
      from = null;
    });
    image.addEventListener("pointercancel", () => { from = null; });
  }
  show(0);
}

const canvas = document.querySelector("#splats");
if (canvas) {
  const text = document.querySelector("#splat-bytes").textContent.trim();
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const scene = JSON.parse(document.querySelector("#splat-scene").textContent);
  if (!viewSplats(canvas, bytes, scene)) {
    canvas.parentElement.querySelector("figcaption").textContent =
      "This browser has no WebGL 2, so the splats are not drawn.";
    canvas.remove();
  }
}
