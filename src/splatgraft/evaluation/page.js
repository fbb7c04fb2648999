"use strict";
(() => {
  const views = JSON.parse(document.getElementById("views").textContent);
  if (!views.length) return;
  const get = (id) => document.getElementById(id);
  const compare = document.querySelector(".compare");
  const labels = Object.keys(views[0].files);
  const chosen = { left: labels[0], right: labels[Math.min(1, labels.length - 1)], view: 0 };
  const thumbs = [...document.querySelectorAll(".thumb")];
  // a link such as index.html#8 opens that view
  const linked = Number.parseInt(location.hash.slice(1), 10);
  if (linked >= 0 && linked < views.length) chosen.view = linked;

  const show = () => {
    const view = views[chosen.view];
    for (const side of ["left", "right"]) {
      const label = chosen[side] in view.files ? chosen[side] : Object.keys(view.files)[0];
      get(side).src = view.files[label];
      get(side).alt = label;
      document.querySelector(side === "left" ? ".tag.start" : ".tag.end").textContent = label;
      for (const button of get("choose-" + side).querySelectorAll("button"))
        button.setAttribute("aria-pressed", String(button.textContent === label));
    }
    compare.style.aspectRatio = view.width + "/" + view.height;
    const use = view.held_out ? "held out: used by no step" : "used by earlier steps";
    get("caption").textContent = view.name + " \u00b7 " + use;
    thumbs.forEach((thumb, i) => thumb.setAttribute("aria-current", String(i === chosen.view)));
  };
  for (const side of ["left", "right"])
    for (const label of labels) {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = label;
      button.addEventListener("click", () => { chosen[side] = label; show(); });
      get("choose-" + side).append(button);
    }
  thumbs.forEach((thumb, i) => thumb.addEventListener("click", () => { chosen.view = i; show(); }));
  get("split").addEventListener("input", (event) => compare.style.setProperty("--split", event.target.value + "%"));
  show();
})();
