"use strict";
// What viser's page has no control for: hands on the object, the divider between two pictures, lights that are dragged on
// the picture of the sky, and the word that the editor has ended. `preview_panel.py` says what the server tells of the
// picture, `hands.py` and `light_phase.py` what they answer.
(() => {
  const CLICK_PX = 4, STALE_MS = 1500, ALIVE_MS = 2000, SWAP_MS = 200, DECODE_MS = 300, HELD_MS = 8000;
  const FLY = new Set(["KeyW", "KeyA", "KeyS", "KeyD", "KeyQ", "KeyE", "ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown"]);
  const MODES = { move: ["Move", "W"], turn: ["Turn", "R"], size: ["Size", "S"], lift: ["Lift", "E"] };
  const KEYS = { KeyW: "move", KeyR: "turn", KeyS: "size", KeyE: "lift" };
  const over = document.createElement("div");
  over.id = "sg-over";
  over.innerHTML =
    '<img class="sg-before" alt="" hidden><img class="sg-drag" alt="" hidden><div class="sg-line" role="slider" hidden></div>' +
    '<span class="sg-name" style="left:12px" hidden></span><span class="sg-name" style="right:12px" hidden></span>' +
    `<div id="sg-tools" hidden>${Object.entries(MODES).map(([mode, [name, key]]) =>
      `<button data-mode="${mode}">${name}<kbd>${key}</kbd></button>`).join("")}</div>`;
  const pause = (ms) => new Promise((done) => setTimeout(done, ms));
  const part = (selector) => over.querySelector(selector);
  const before = part(".sg-before"), dragged = part(".sg-drag"), line = part(".sg-line"), tools = part("#sg-tools");
  const names = over.querySelectorAll(".sg-name");
  line.setAttribute("aria-label", "compare");
  let state = { version: -1, hulls: [] }, split = 0, isMoving = false, isWhole = false, mode = "move", grab = null;

  // what the server says of the picture on the canvas

  function read() {
    const canvas = document.querySelector("canvas");
    if (canvas && over.parentElement !== canvas.parentElement) canvas.parentElement.appendChild(over);
    const found = document.querySelector(".sg-state");
    if (!found || Number(found.dataset.version) === state.version) return;
    state = JSON.parse(found.textContent);
    state.version = Number(found.dataset.version);
    isMoving = false;
    if (state.before) before.src = state.before;
    // the canvas takes a moment to show the picture that the state came with
    if (!grab) hideDragged();
    show();
  }

  function show() {
    const isThere = Boolean(state.before) && !isMoving && dragged.hidden;
    before.hidden = line.hidden = !isThere;
    before.style.clipPath = `inset(0 ${isWhole ? 0 : 100 * (1 - split)}% 0 0)`;
    line.style.left = `clamp(14px, ${100 * split}%, calc(100% - 14px))`;
    line.setAttribute("aria-valuenow", Math.round(100 * split));
    const shown = isWhole ? 1 : split;
    names[0].hidden = !isThere || shown < 0.02;
    names[1].hidden = !isThere || shown < 0.02 || shown > 0.98;
    [names[0].textContent, names[1].textContent] = state.names || ["", ""];
    tools.hidden = !state.hulls.length;
    for (const button of tools.children) button.setAttribute("aria-pressed", String(button.dataset.mode === mode));
  }

  function hideDragged() {
    setTimeout(() => {
      if (grab) return;
      dragged.hidden = true;
      show();
    }, SWAP_MS);
  }

  function setMode(wanted) {
    mode = wanted;
    show();
  }

  function viewMoves() {
    if (!state.before || isMoving) return;
    isMoving = true;
    show();
    // where the view did not change after all, no new picture comes
    const version = state.version;
    setTimeout(() => { if (state.version === version) { isMoving = false; show(); } }, STALE_MS);
  }

  // hands on the object

  function at(event) {
    const box = over.getBoundingClientRect();
    return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
  }

  function isInside([x, y], hull) {
    let inside = false;
    for (let i = 0, j = hull.length - 1; i < hull.length; j = i++) {
      const [[a, b], [c, d]] = [hull[i], hull[j]];
      if (b > y !== d > y && x < ((c - a) * (y - b)) / (d - b) + a) inside = !inside;
    }
    return inside;
  }

  const ask = (what, query) =>
    fetch(`hand/${what}?${new URLSearchParams({ window: state.window, ...query })}`, { cache: "no-store" });

  async function pump() {
    if (!grab || grab.isBusy) return;
    grab.isBusy = true;
    const held = grab;
    try {
      while (held.next) {
        const [what, query] = held.next;
        held.next = null;
        const answer = await ask(what, query);
        if (answer.status === 200) {
          const url = URL.createObjectURL(await answer.blob());
          const old = dragged.src;
          dragged.src = url;
          // a browser may put off decoding for a page that is not seen
          await Promise.race([dragged.decode().catch(() => undefined), pause(DECODE_MS)]);
          if (old) URL.revokeObjectURL(old);
          dragged.hidden = false;
          show();
        }
      }
      if (held.end) {
        held.version = state.version;
        await ask(held.end, held.at);
      }
    } finally {
      held.isBusy = false;
      if (held.end && grab === held) {
        grab = null;
        if (held.end === "cancel" || !held.hasMoved) dragged.hidden = true;
        // the picture with the object at its new place may have come before the answer
        else if (state.version !== held.version) hideDragged();
        else setTimeout(hideDragged, HELD_MS);
        setMode("move");
      }
    }
  }

  function onDown(event) {
    if (event.target.tagName !== "CANVAS" || event.button !== 0 || event.ctrlKey || event.metaKey || grab) return;
    const place = at(event), index = state.hulls.findLastIndex((hull) => isInside(place, hull));
    if (index < 0 || isMoving) return;
    event.stopImmediatePropagation();
    event.preventDefault();
    document.activeElement?.blur();
    const [x, y] = place;
    const how = event.shiftKey ? "lift" : mode;
    grab = { pointer: event.pointerId, from: [event.clientX, event.clientY], next: ["grab", { object: index, mode: how, x, y }] };
    grab.at = { x, y };
    pump();
  }

  function onMove(event) {
    if (grab && event.pointerId === grab.pointer) {
      event.stopImmediatePropagation();
      grab.hasMoved ||= Math.hypot(event.clientX - grab.from[0], event.clientY - grab.from[1]) > CLICK_PX;
      const [x, y] = at(event);
      grab.at = { x, y };
      // the grab itself must not be replaced by the first move
      if (grab.hasMoved && !grab.end && grab.next?.[0] !== "grab") grab.next = ["drag", grab.at];
      pump();
    } else if (event.target.tagName === "CANVAS") {
      if (event.buttons) viewMoves();
      else event.target.style.cursor = state.hulls.some((hull) => isInside(at(event), hull)) ? "grab" : "";
    }
  }

  function onUp(event) {
    if (!grab || event.pointerId !== grab.pointer) return;
    event.stopImmediatePropagation();
    if (grab.end) return; // Escape was pressed
    grab.end = grab.hasMoved && event.type === "pointerup" ? "drop" : "cancel";
    pump();
  }

  function isTyping() {
    const element = document.activeElement;
    return Boolean(element) && (/^(INPUT|TEXTAREA|SELECT)$/.test(element.tagName) || element.isContentEditable);
  }

  function onKey(event) {
    if (isTyping()) return;
    const isDown = event.type === "keydown", isPlain = !event.ctrlKey && !event.metaKey && !event.altKey && !event.shiftKey;
    if (event.code === "Tab" || (event.code === "Space" && document.activeElement === document.body)) {
      if (!state.before && !isWhole) return;
      event.preventDefault();
      isWhole = isDown;
      show();
    } else if (isDown && isPlain && state.hulls.length && event.code in KEYS) {
      setMode(KEYS[event.code]);
    } else if (isDown && event.code === "Escape") {
      if (grab) { grab.end = "cancel"; grab.next = null; pump(); }
      setMode("move");
    }
  }

  // the divider, and the lights on the picture of the sky

  function slide(element, onSlide) {
    element.addEventListener("pointerdown", (event) => {
      event.preventDefault();
      event.stopPropagation();
      element.setPointerCapture(event.pointerId);
      const end = () => element.removeEventListener("pointermove", onSlide);
      element.addEventListener("pointermove", onSlide);
      element.addEventListener("pointerup", end, { once: true });
      element.addEventListener("pointercancel", end, { once: true });
    });
  }
  slide(line, (event) => { split = Math.min(1, Math.max(0, at(event)[0])); show(); });
  line.addEventListener("dblclick", () => { split = split ? 0 : 0.5; show(); });

  let light = null;
  async function sendLight() {
    if (!light || light.isBusy) return;
    light.isBusy = true;
    const held = light;
    try {
      while (held.next) { const query = held.next; held.next = null; await ask("light", query); }
    } finally {
      held.isBusy = false;
      if (held.isEnded && light === held) light = null;
    }
  }
  document.addEventListener("pointerdown", (event) => {
    const dot = event.target.closest?.(".sg-dome .sg-light");
    if (!dot) return;
    event.preventDefault();
    light = { pointer: event.pointerId, source: dot.dataset.source, dome: dot.closest("svg") };
  });
  document.addEventListener("pointermove", (event) => moveLight(event, false));
  for (const type of ["pointerup", "pointercancel"]) document.addEventListener(type, (event) => moveLight(event, true));
  function moveLight(event, isEnd) {
    if (!light || light.isEnded || event.pointerId !== light.pointer) return;
    const box = light.dome.getBoundingClientRect();
    let x = (2 * (event.clientX - box.left)) / box.width - 1, y = (2 * (event.clientY - box.top)) / box.height - 1;
    // the picture of the sky has a margin of a tenth
    x /= 0.9; y /= 0.9;
    const length = Math.max(1, Math.hypot(x, y));
    [x, y] = [x / length, y / length];
    // the panel may have been drawn again: its dot by the number of its light
    const dot = document.querySelector(`.sg-dome .sg-light[data-source="${light.source}"]`);
    dot?.setAttribute("cx", 90 * x);
    dot?.setAttribute("cy", 90 * y);
    light.next = { source: light.source, x, y, end: isEnd ? 1 : 0 };
    light.isEnded = isEnd;
    sendLight();
  }

  // the editor may end while its page stays open

  const dead = document.createElement("div");
  dead.id = "sg-dead";
  dead.textContent = "The editor has ended. What was saved is kept: start `splatgraft edit` again and open its address.";
  let missed = 0;
  setInterval(async () => {
    const answer = await fetch("alive", { cache: "no-store" }).catch(() => null);
    missed = answer && answer.ok ? 0 : missed + 1;
    document.body.classList.toggle("sg-dead", missed > 1);
  }, ALIVE_MS);

  // viser's own listeners are on the document and below: these come first
  window.addEventListener("pointerdown", onDown, true);
  window.addEventListener("pointermove", onMove, true);
  window.addEventListener("pointerup", onUp, true);
  window.addEventListener("pointercancel", onUp, true);
  window.addEventListener("wheel", (event) => { if (event.target.tagName === "CANVAS") viewMoves(); }, { capture: true, passive: true });
  window.addEventListener("keydown", onKey, true);
  window.addEventListener("keyup", onKey, true);
  window.addEventListener("blur", () => { isWhole = false; show(); });
  // its keys that fly the camera are listened to on the document, its hotkeys on the element below
  document.documentElement.addEventListener("keydown", (event) => { if (FLY.has(event.code)) event.stopPropagation(); });
  tools.addEventListener("click", (event) => {
    const button = event.target.closest("button");
    if (button) { setMode(button.dataset.mode); button.blur(); }
  });
  function start() {
    document.body.appendChild(dead);
    new MutationObserver(read).observe(document.body, { childList: true, subtree: true, characterData: true });
    read();
  }
  if (document.body) start();
  else document.addEventListener("DOMContentLoaded", start);
})();
