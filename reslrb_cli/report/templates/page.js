"use strict";

// A slider over the final image of each sensor: the start or the target to its left, the final image to its right.
for (const row of document.querySelectorAll(".figures.large")) {
  const found = [...row.querySelectorAll("img[data-moment]")];
  const end = found.find(image => image.dataset.moment == "end");
  const others = found.filter(image => image != end);
  if (!end || !others.length) continue;
  const make = (name, parent, values) => parent.appendChild(Object.assign(document.createElement(name), values));
  const block = document.createElement("div");
  block.className = "compare";
  const stage = make("div", block, {className: "stage"});
  const natural = [end.getAttribute("width"), end.getAttribute("height")].map(Number);
  stage.style.aspectRatio = natural.join("/");
  stage.style.width = `min(100%, ${(75 * natural[0] / natural[1]).toFixed(1)}vh)`;
  for (const [image, alt] of [[end, end.alt], [others[0], others[0].alt]])
    make("img", stage, {src: image.src, alt, className: end.className});
  const over = stage.lastChild;
  const controls = make("div", block, {className: "controls"});
  const choice = make("select", controls, {ariaLabel: "left image"});
  for (const image of others) make("option", choice, {textContent: image.dataset.moment});
  const slider = make("input", controls, {type: "range", min: 0, max: 100, value: 50, ariaLabel: "border between the images"});
  make("span", controls, {textContent: "end"});
  const show = () => {
    const image = others[choice.selectedIndex];
    if (over.src != image.src) Object.assign(over, {src: image.src, alt: image.alt});
    over.style.clipPath = `inset(0 ${100 - slider.value}% 0 0)`;
  };
  choice.oninput = slider.oninput = show;
  show();
  row.before(block);
}

// A click on a picture shows its pixels as squares, until the next click.
for (const image of document.querySelectorAll("figure img")) {
  image.classList.add("zoomable");
  image.onclick = () => {
    const [width, height] = ["width", "height"].map(name => Number(image.getAttribute(name)));
    const factor = Math.max(2, Math.floor(Math.min(innerWidth / width, innerHeight / height)));
    const dialog = document.body.appendChild(document.createElement("dialog"));
    const {src, alt} = image, size = {width: factor * width, height: factor * height};
    Object.assign(dialog.appendChild(document.createElement("img")), {src, alt}, size);
    dialog.onclick = () => dialog.close();
    dialog.onclose = () => dialog.remove();
    dialog.showModal();
  };
}
