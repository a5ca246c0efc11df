"use strict";

const make = (name, parent, values) => parent.appendChild(Object.assign(document.createElement(name), values));

// Show the pixels of a picture as squares, until the next click.
const zoom = image => {
  const [width, height] = [image.naturalWidth, image.naturalHeight];
  const factor = Math.max(2, Math.floor(Math.min(innerWidth / width, innerHeight / height)));
  const dialog = make("dialog", document.body, {});
  make("img", dialog, {src: image.src, alt: image.alt, width: factor * width, height: factor * height});
  dialog.onclick = () => dialog.close();
  dialog.onclose = () => dialog.remove();
  dialog.showModal();
};

// A slider over the final image of each sensor, in place of the pictures: the start or the target to its left, the
// final image to its right. A drag on the picture moves the border, a click enlarges the picture under it.
document.querySelectorAll(".figures.large").forEach((row, number) => {
  const found = [...row.querySelectorAll("img[data-moment]")];
  const end = found.find(image => image.dataset.moment == "end");
  const others = found.filter(image => image != end);
  if (!end || !others.length) return;
  const block = document.createElement("div");
  block.className = "compare";
  const stage = make("div", block, {className: "stage"});
  const natural = [end.getAttribute("width"), end.getAttribute("height")].map(Number);
  stage.style.aspectRatio = natural.join("/");
  stage.style.width = `min(100%, ${(75 * natural[0] / natural[1]).toFixed(1)}vh)`;
  for (const [image, alt] of [[end, end.alt], [others[0], others[0].alt]])
    make("img", stage, {src: image.src, alt, className: end.className, draggable: false});
  const over = stage.lastChild;
  const controls = make("div", block, {className: "controls"});
  const choice = make("select", controls, {ariaLabel: "left image"});
  for (const image of others) make("option", choice, {textContent: image.dataset.moment});
  const slider = make("input", controls, {type: "range", min: 0, max: 100, value: 50, ariaLabel: "border between the images"});
  make("span", controls, {textContent: "end"});
  [slider.value, choice.selectedIndex] = history.state?.[number] ?? [50, 0]; // as before the page was loaded again
  const show = () => {
    const image = others[choice.selectedIndex] ?? others[0];
    if (over.src != image.src) Object.assign(over, {src: image.src, alt: image.alt});
    over.style.clipPath = `inset(0 ${100 - slider.value}% 0 0)`;
  };
  choice.oninput = slider.oninput = () => {
    show();
    history.replaceState({...history.state, [number]: [slider.value, choice.selectedIndex]}, "");
  };
  const share = event => 100 * (event.clientX - stage.getBoundingClientRect().x) / stage.clientWidth;
  let start = null, moved = false;
  stage.onpointerdown = event => {
    [start, moved] = [event.clientX, false];
    stage.setPointerCapture(event.pointerId);
  };
  stage.onpointermove = event => {
    if (start === null || !(moved ||= Math.abs(event.clientX - start) > 3)) return;
    slider.value = share(event);
    slider.oninput();
  };
  stage.onpointerup = stage.onpointercancel = () => start = null;
  stage.onclick = event => moved || zoom(share(event) < slider.value ? over : stage.firstChild);
  show();
  row.before(block);
  for (const image of found) image.closest("figure").hidden = true;
});

for (const image of document.querySelectorAll("figure img")) {
  image.classList.add("zoomable");
  image.onclick = () => zoom(image);
}

// The page of a run in progress loads itself again, but not while a picture is enlarged or the border is dragged.
if (document.body.dataset.reload) {
  let held = false;
  onpointerdown = () => held = true;
  onpointerup = onpointercancel = () => held = false;
  const reload = () => held || document.querySelector("dialog") ? setTimeout(reload, 1000) : location.reload();
  setTimeout(reload, 1000 * document.body.dataset.reload);
}
