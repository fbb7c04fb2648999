// The editor's page. It draws what `editor.py` describes and sends what a user does; it knows nothing of scenes.
"use strict";
const CLICK_PX = 4, RETRY_MS = 1500, WHEEL = 1 / 400;
const $ = (id) => document.getElementById(id);
const view = $("view"), picture = $("picture"), over = $("over"), divider = $("divider");
let socket = null, panel = { controls: [], tools: [] }, head = {}, split = 0, isWhole = false, mode = "move";
let held = null, offered = null, sliding = null;

// the connection

function connect() {
  socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/socket`);
  socket.binaryType = "arraybuffer";
  socket.onopen = () => { $("dead").hidden = true; sendSize(); sendSplit(); };
  socket.onmessage = ({ data }) => (typeof data === "string" ? showPanel(JSON.parse(data)) : showPicture(data));
  socket.onclose = (event) => {
    if (event.reason) $("dead").textContent = event.reason;
    $("dead").hidden = false;
    setTimeout(connect, RETRY_MS);
  };
}
const send = (t, rest) => { if (socket.readyState === 1) socket.send(JSON.stringify({ t, ...rest })); };
function sendSize() {
  const ratio = Math.min(2, devicePixelRatio || 1);
  send("size", { w: Math.max(1, Math.round(view.clientWidth * ratio)), h: Math.max(1, Math.round(view.clientHeight * ratio)) });
}
const sendSplit = () => send("split", { x: isWhole ? 1 : split });

// pictures, and what lies over them

async function showPicture(data) {
  const length = new DataView(data).getUint32(0, true);
  const found = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
  const bitmap = await createImageBitmap(new Blob([new Uint8Array(data, 4 + length)], { type: "image/jpeg" }));
  if (found.n > (head.n || 0) || found.n === 1) {
    head = found;
    if (picture.width !== bitmap.width || picture.height !== bitmap.height) [picture.width, picture.height] = [bitmap.width, bitmap.height];
    picture.getContext("2d").drawImage(bitmap, 0, 0);
    document.body.dataset.picture = `${found.n} ${found.full ? "full" : "moving"} ${found.caption}`;
    drawOver();
  }
  bitmap.close();
  send("ack", { n: found.n });
}

const shapeOf = (points, isClosed) => new Path2D(`M${points.join("L")}${isClosed ? "Z" : ""}`);

function drawOver() {
  const [w, h] = [view.clientWidth, view.clientHeight], ratio = devicePixelRatio || 1;
  [over.width, over.height] = [w * ratio, h * ratio];
  const c = over.getContext("2d");
  c.scale(ratio, ratio);
  const placed = (points) => points.map(([x, y]) => [x * w, y * h]);
  const stroke = (shape, color, width) => { c.lineWidth = width; c.strokeStyle = color; c.stroke(shape); };
  const paint = (shape, color) => { c.fillStyle = color; c.fill(shape); };
  for (const line of head.lines || []) {
    const points = placed(line.points);
    stroke(shapeOf(points, line.closed), line.color, line.width || 2);
    if (line.arrow) {
      const [[a, b], [x, y]] = points, angle = Math.atan2(y - b, x - a);
      const wing = (turn) => [x - 14 * Math.cos(angle + turn), y - 14 * Math.sin(angle + turn)];
      paint(shapeOf([wing(-0.4), [x, y], wing(0.4)], true), line.color);
    }
  }
  const hover = held && held.on.startsWith("object:") ? Number(held.on.slice(7)) : hoverAt;
  (head.hulls || []).forEach((hull, i) => {
    if (i === hover || i === head.chosen) stroke(shapeOf(placed(hull), true), i === hover ? "#fffc" : "#fff8", 1.5);
  });
  for (const dot of head.dots || []) {
    const shape = new Path2D(), [[x, y]] = placed([dot.at]);
    shape.arc(x, y, dot.id ? 8 : 6, 0, 7);
    paint(shape, dot.color);
    stroke(shape, "#fff", 2);
  }
  if (held && held.rectangle) {
    const [x, y] = held.from, [u, v] = held.at;
    c.setLineDash([5, 4]);
    c.lineWidth = 1.5;
    c.strokeStyle = "#fff";
    c.strokeRect(x * w, y * h, (u - x) * w, (v - y) * h);
  }
  $("caption").textContent = head.problem || (head.full ? head.caption : "");
  divider.hidden = !panel.project || !(panel.controls || []).some((one) => one.id === "before");
  divider.style.left = `clamp(14px, ${100 * (isWhole ? 1 : split)}%, calc(100% - 14px))`;
  divider.setAttribute("aria-valuenow", Math.round(100 * split));
}

// the panel: controls are kept while they are of the same kind, so that what is being typed stays

function showPanel(found) {
  panel = found;
  const editing = found.editing;
  $("project").textContent = found.project;
  $("saved").textContent = found.saved;
  $("saved").className = found.saved === "not saved" ? "bad" : "";
  $("watch").hidden = editing;
  $("status").textContent = found.status;
  $("status").className = found.bad ? "bad" : "";
  $("undo").disabled = !found.undo || !editing;
  $("redo").disabled = !found.redo || !editing;
  $("steps").disabled = !editing;
  const step = found.steps.find(([, mark]) => mark === "●");
  fill($("steps"), found.steps, ([name], old) => {
    const button = old || element("button", { onclick: () => send("step", { to: button.dataset.step }) });
    button.dataset.step = name;
    return button;
  }, (button, [name, mark]) => {
    button.textContent = mark && mark !== "●" ? `${mark} ${name}` : name;
    button.setAttribute("aria-current", step && step[0] === name ? "step" : "false");
  });
  for (const [place, isMore] of [[$("controls"), false], [$("rest"), true]]) {
    const controls = found.controls.filter((one) => Boolean(one.more) === isMore);
    fill(place, controls, (one) => Object.assign(KINDS[one.kind].make(one), { title: one.hint || "" }), (made, one) => {
      made.dataset.id = one.id;
      KINDS[one.kind].update?.(made, one);
    });
    place.disabled = !editing;
  }
  $("more").hidden = !found.controls.some((one) => one.more);
  showTools(found.tools || []);
  if (found.offer && offered !== null && found.offer.n > offered) element("a", { href: found.offer.url, download: found.offer.name }).click();
  offered = found.offer ? found.offer.n : 0;
  document.body.dataset.step = step ? step[0] : "";
  drawOver();
}

function element(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

function fill(place, items, make, update) {
  const old = new Map([...place.children].map((child) => [child.dataset.key, child]));
  items.forEach((item, i) => {
    const key = Array.isArray(item) ? item[0] : `${item.kind}:${item.id}`;
    let child = old.get(key);
    if (!child) {
      child = make(item);
      child.dataset.key = key;
    }
    old.delete(key);
    if (place.children[i] !== child) place.insertBefore(child, place.children[i] || null);
    update?.(child, item);
  });
  for (const child of old.values()) child.remove();
}

const act = (one, value) => send("do", { id: one.id, value });

// kinds of controls: `make` a control once, and `update` it whenever it may have changed
const KINDS = {
  note: {
    make: () => element("p"),
    update: (made, one) => Object.assign(made, { textContent: one.text, className: `note ${one.bad ? "bad" : ""} ${one.faint ? "faint" : ""}` }),
  },
  button: {
    make: (one) => element("div", { className: "wide" }, element("button", { onclick: () => act(one) })),
    update: (made, one) => Object.assign(made.firstChild, { textContent: one.label, className: one.main ? "main" : "", disabled: Boolean(one.disabled) }),
  },
  buttons: { make: () => element("div", { className: "group wide" }), update: updateButtons },
  rows: { make: () => element("div", { className: "rows" }), update: updateButtons },
  check: {
    make: (one) => row(one, element("input", { type: "checkbox", onchange: (e) => act(one, e.target.checked) })),
    update: (made, one) => { made.querySelector("input").checked = Boolean(one.value); },
  },
  choice: {
    make: (one) => row(one, element("select", { onchange: (e) => { act(one, e.target.value); e.target.blur(); } })),
    update: (made, one) => {
      const input = made.querySelector("select");
      if (one.options.join("\n") !== [...input.options].map((o) => o.value).join("\n")) input.replaceChildren(...one.options.map((o) => element("option", { value: o, textContent: o })));
      input.value = one.value;
    },
  },
  text: {
    make: makeText,
    update: (made, one) => { const input = made.querySelector("input"); if (document.activeElement !== input) input.value = one.value || ""; },
  },
  numbers: { make: (one) => row(one, element("div", { className: "numbers" })), update: (made, one) => updateNumbers(made.querySelector(".numbers"), one) },
  slider: {
    make: makeSlider,
    update: (made, one) => {
      const input = made.querySelector("input"), value = one.value || 0;
      Object.assign(input, { min: one.min, max: one.max, step: one.step });
      if (sliding === one.id) return;
      input.value = value;
      made.querySelector(".numbers > span").textContent = value;
    },
  },
  upload: { make: makeUpload },
  drawing: {
    make: makeDrawing,
    update: (made, one) => { if (!made.dataset.busy && made.dataset.svg !== one.svg) { made.innerHTML = one.svg; made.dataset.svg = one.svg; } },
  },
  progress: { make: () => element("progress", { max: 1 }), update: (made, one) => { made.value = one.value || 0; } },
  links: { make: () => element("div"), update: (made, one) => made.replaceChildren(...one.options.map(linkLine)) },
};

function row(one, ...parts) {
  return element("label", { className: "control" }, element("span", { textContent: one.label }), ...parts);
}

function updateButtons(made, one) {
  fill(made, one.options.map((name) => [name]), ([name]) => element("button", { textContent: name, onclick: () => act(one, name) }));
}

function linkLine([name, remark, opens, download]) {
  const line = element("p", { className: "note" }, `${name}${remark ? `, ${remark}` : ""} `);
  if (opens) line.append(element("a", { href: opens, target: "_blank", rel: "noopener", textContent: "open" }), " ");
  if (download) line.append(element("a", { href: download, download: "", textContent: "download" }));
  return line;
}

function makeText(one) {
  const input = element("input", { type: "text", spellcheck: false, onchange: () => act(one, input.value) });
  const parts = element("div", { className: "numbers" }, input);
  if (one.browse) parts.append(element("button", { textContent: "…", title: "Choose a folder", onclick: (e) => { e.preventDefault(); act({ id: `browse_${one.id}` }); } }));
  return row(one, parts);
}

function makeSlider(one) {
  const shown = element("span"), input = element("input", { type: "range" });
  input.oninput = () => {
    shown.textContent = input.value;
    sliding = one.id;
    send("live", { id: one.id, value: Number(input.value) });
  };
  input.onchange = () => { sliding = null; act(one, Number(input.value)); input.blur(); };
  return row(one, element("div", { className: "numbers" }, input, shown));
}

function makeUpload(one) {
  const input = element("input", { type: "file", hidden: true, multiple: Boolean(one.many), accept: one.accept });
  const label = element("label", { className: "upload wide" }, element("span", { textContent: one.label }), input);
  const take = async (files) => {
    const folder = files.length > 1 || /^image\//.test((files[0] || {}).type) ? `photos_${Date.now() % 1e12}/` : "";
    for (const [i, file] of [...files].entries()) {
      $("status").textContent = `${file.name}: being uploaded (${i + 1} of ${files.length})`;
      const query = new URLSearchParams({ window: panel.window, name: folder + file.name, use: one.id });
      const answer = await fetch(`upload?${query}`, { method: "POST", body: file });
      if (!answer.ok) { $("status").textContent = await answer.text(); $("status").className = "bad"; return; }
    }
  };
  input.onchange = async () => { await take(input.files); input.value = ""; };
  label.ondragover = (event) => { event.preventDefault(); label.classList.add("drop"); };
  label.ondragleave = () => label.classList.remove("drop");
  label.ondrop = (event) => { event.preventDefault(); label.classList.remove("drop"); take(event.dataTransfer.files); };
  return label;
}

function makeDrawing(one) {
  const made = element("div");
  let dot = null;
  const at = (event) => {
    const box = made.firstElementChild.getBoundingClientRect();
    // the drawing has a margin of a tenth
    const x = ((2 * (event.clientX - box.left)) / box.width - 1) / 0.9, y = ((2 * (event.clientY - box.top)) / box.height - 1) / 0.9;
    const length = Math.max(1, Math.hypot(x, y));
    return [x / length, y / length];
  };
  made.onpointerdown = (event) => {
    const found = event.target.closest(".light");
    if (!found || !panel.editing) return;
    event.preventDefault();
    made.setPointerCapture(event.pointerId);
    dot = Number(found.dataset.source);
    made.dataset.busy = "1";
  };
  made.onpointermove = (event) => {
    if (dot === null) return;
    const [x, y] = at(event), circle = made.querySelector(`[data-source="${dot}"]`);
    circle.setAttribute("cx", 90 * x);
    circle.setAttribute("cy", 90 * y);
    throttled(() => send("live", { id: one.id, value: [dot, x, y, false] }));
  };
  made.onpointerup = made.onpointercancel = (event) => {
    if (dot === null) return;
    act(one, [dot, ...at(event), true]);
    dot = null;
    delete made.dataset.busy;
  };
  return made;
}

function updateNumbers(place, one) {
  const shown = (value) => String(Math.abs(value) >= 1e6 || (value && Math.abs(value) < 1e-4) ? value : Math.round(value * 1e4) / 1e4);
  while (place.children.length < one.value.length) {
    const input = element("input", { type: "number", step: one.step });
    input.onchange = () => {
      const values = [...place.children].map((field, i) => (field === input ? (field.value === "" ? NaN : Number(field.value)) : place.values[i]));
      if (values.every(Number.isFinite)) act(one, values);
      else updateNumbers(place, { ...one, value: place.values }); // an emptied field shows its number again
    };
    input.onblur = () => setTimeout(() => updateNumbers(place, { ...one, value: place.values }));
    place.append(input);
  }
  place.values = one.value;
  [...place.children].forEach((input, i) => {
    if (document.activeElement !== input) input.value = shown(one.value[i]);
  });
}

function showTools(tools) {
  $("tools").hidden = !tools.length || !panel.editing;
  fill($("tools"), tools, ([name, label, key]) => element("button", { onclick: () => setMode(name) }, label, element("kbd", { textContent: key })),
    (button, [name]) => button.setAttribute("aria-pressed", String(name === mode)));
}
function setMode(name) {
  mode = name;
  showTools(panel.tools || []);
}

// the pointer on the view

const plane = document.createElement("canvas").getContext("2d"); // for its geometry alone
let hoverAt = -1, waiting = null, pointers = new Map();
function throttled(work) {
  const isFirst = !waiting;
  waiting = work;
  if (isFirst) requestAnimationFrame(() => { const now = waiting; waiting = null; now(); });
}
const at = (event) => {
  const box = view.getBoundingClientRect();
  return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
};
function under(place) {
  const [w, h] = [view.clientWidth, view.clientHeight];
  const dot = (head.dots || []).findLast((one) => one.id && Math.hypot((one.at[0] - place[0]) * w, (one.at[1] - place[1]) * h) < 14);
  if (dot) return dot.id;
  const index = (head.hulls || []).findLastIndex((hull) => plane.isPointInPath(shapeOf(hull, true), ...place));
  return index < 0 ? "" : `object:${index}`;
}

view.addEventListener("pointerdown", (event) => {
  if (event.target === divider || event.target.closest("#tools")) return;
  document.activeElement.blur();
  event.preventDefault();
  view.setPointerCapture(event.pointerId);
  pointers.set(event.pointerId, at(event));
  if (pointers.size > 1) { // a second finger: the view is moved and zoomed
    if (held && held.isSent) point("cancel");
    held = { kind: "pinch", on: "" };
    return;
  }
  const place = at(event), isRight = event.button === 2 || event.button === 1;
  const on = panel.editing && !isRight ? under(place) : "";
  held = { on, from: place, at: place, px: [event.clientX, event.clientY], alt: event.altKey || isRight, shift: event.shiftKey, hasMoved: false };
  if (panel.editing && panel.rectangle && event.shiftKey) held.rectangle = true;
  else if (on || (panel.editing && panel.paint && !isRight)) held.kind = "drag";
  else held.kind = isRight || event.shiftKey || event.ctrlKey ? "pan" : "turn";
  if (held.kind === "drag") point("down");
});
function point(what) {
  held.isSent = true;
  send("pointer", { what, on: held.on, x: held.at[0], y: held.at[1], mode, alt: held.alt, shift: held.shift });
}
view.addEventListener("pointermove", (event) => {
  const place = at(event), [w, h] = [view.clientWidth, view.clientHeight];
  if (!held) {
    const found = panel.editing ? under(place) : "", index = found.startsWith("object:") ? Number(found.slice(7)) : -1;
    view.style.cursor = found ? "grab" : panel.paint ? "crosshair" : "";
    if (index !== hoverAt) { hoverAt = index; drawOver(); }
    return;
  }
  const before = pointers.get(event.pointerId) || place;
  pointers.set(event.pointerId, place);
  if (held.kind === "pinch") {
    const others = [...pointers].filter(([id]) => id !== event.pointerId).map(([, one]) => one);
    if (!others.length) return;
    const far = (one) => Math.hypot((one[0] - others[0][0]) * w, (one[1] - others[0][1]) * h) + 1;
    send("zoom", { by: Math.log2(far(before) / far(place)) });
    send("pan", { x: ((place[0] - before[0]) * w) / h / 2, y: (place[1] - before[1]) / 2 });
    return;
  }
  held.hasMoved ||= Math.hypot(event.clientX - held.px[0], event.clientY - held.px[1]) > CLICK_PX;
  if (!held.hasMoved) return;
  const [dx, dy] = [place[0] - held.at[0], place[1] - held.at[1]];
  held.at = place;
  if (held.rectangle) drawOver();
  else if (held.kind === "drag") { held.alt = event.altKey; throttled(() => held && held.kind === "drag" && point("move")); }
  else send(held.kind, { x: (dx * w) / h, y: dy });
});
function release(event) {
  pointers.delete(event.pointerId);
  if (!held || held.kind === "pinch") { if (!pointers.size) held = null; return; }
  const isUp = event.type === "pointerup";
  waiting = waiting && (() => undefined);
  if (held.rectangle) {
    if (isUp && held.hasMoved) send("pointer", { what: "rectangle", x: held.from[0], y: held.from[1], u: held.at[0], v: held.at[1], alt: held.alt });
  } else if (held.isSent) point(isUp && (held.hasMoved || panel.paint) ? "up" : "cancel");
  if (isUp && !held.hasMoved && !held.rectangle && panel.editing && !(panel.paint && held.isSent)) {
    held.on = "";
    point("click");
  }
  held = null;
  drawOver();
}
view.addEventListener("pointerup", release);
view.addEventListener("pointercancel", release);
view.addEventListener("contextmenu", (event) => event.preventDefault());
view.addEventListener("wheel", (event) => {
  event.preventDefault();
  send("zoom", { by: Math.max(-1, Math.min(1, event.deltaY * WHEEL)) });
}, { passive: false });

divider.addEventListener("pointerdown", (event) => {
  event.preventDefault();
  divider.setPointerCapture(event.pointerId);
  divider.onpointermove = (move) => { split = Math.min(1, Math.max(0, at(move)[0])); throttled(sendSplit); drawOver(); };
});
divider.addEventListener("pointerup", () => { divider.onpointermove = null; sendSplit(); });
divider.addEventListener("dblclick", () => { split = split ? 0 : 0.5; sendSplit(); drawOver(); });

// keys

const isTyping = () => /^(INPUT|TEXTAREA|SELECT)$/.test((document.activeElement || {}).tagName || "") && document.activeElement.type !== "range";
const SENT = new Set(["f", "home", "g", "b", "delete", "backspace", "escape", "arrowleft", "arrowright", "arrowup", "arrowdown", "ctrl+z", "ctrl+shift+z", "ctrl+d", "shift+s"]);
addEventListener("keydown", (event) => {
  if (isTyping()) {
    if (event.key === "Enter" && /^(text|number)$/.test(event.target.type)) event.target.blur();
    return;
  }
  const key = (event.ctrlKey || event.metaKey ? "ctrl+" : "") + (event.shiftKey ? "shift+" : "") + event.key.toLowerCase();
  const tool = (panel.tools || []).find(([, , letter]) => letter.toLowerCase() === key);
  if (key === "tab" || (key === " " && document.activeElement === document.body)) {
    event.preventDefault();
    if (!isWhole) { isWhole = true; sendSplit(); drawOver(); }
    return;
  }
  if (!panel.editing) return;
  if (key === "escape") {
    if (held && held.isSent) { point("cancel"); held = null; }
    setMode("move");
  }
  if (tool) setMode(tool[0]);
  else if (/^[1-6]$/.test(key) && panel.steps) send("step", { to: panel.steps[key - 1][0] });
  else if (SENT.has(key)) { event.preventDefault(); send("key", { key }); }
});
const showSplit = () => { if (isWhole) { isWhole = false; sendSplit(); drawOver(); } };
addEventListener("keyup", (event) => { if (event.key === "Tab" || event.key === " ") showSplit(); });
addEventListener("blur", showSplit);
$("undo").onclick = () => send("key", { key: "ctrl+z" });
$("redo").onclick = () => send("key", { key: "ctrl+shift+z" });
new ResizeObserver(() => { if (socket && socket.readyState === 1) sendSize(); drawOver(); }).observe(view);
connect();
