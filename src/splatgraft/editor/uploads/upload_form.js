"use strict";
/*
 * The upload form of the editor's page, as custom elements that the panel contains:
 *   <splatgraft-upload form label accept>   the button, the place to drop a file, and the upload's progress
 *   <splatgraft-upload-progress>            the progress while the form of the upload is out of view
 *   <splatgraft-window key>                 the key of this window, which the server has sent to it alone
 * The upload belongs to the page, not to an element: viser's page removes and draws elements when the step changes.
 * upload_receiver.py describes the messages.
 */
(() => {
  const PART_BYTES = 128 * 1024;
  const AHEAD_BYTES = 16 * PART_BYTES; // sent before they are acknowledged
  const SAMPLE_BYTES = 64 * 1024; // as in incoming_upload.py
  const SILENT_MS = 30000; // after which a connection is taken for lost
  const PAUSES_MS = [500, 10000]; // the first and the longest between two attempts to connect

  const elements = new Set();
  let windowKey = "";
  let upload = null;

  const redraw = () => elements.forEach((element) => element.draw());
  const megabytes = (bytes) =>
    (bytes / 1e6).toLocaleString("en", { minimumFractionDigits: 1, maximumFractionDigits: 1 });

  async function read(file, from, to) {
    const bytes = await file.slice(from, to).arrayBuffer();
    if (bytes.byteLength !== Math.min(to, file.size) - from) throw new Error("the file has changed");
    return bytes;
  }

  class Upload {
    constructor(file, form) {
      Object.assign(this, { file, form, state: "connecting", text: "", received: 0, sent: 0, heard: Date.now() });
      Object.assign(this, { socket: null, wasAccepted: false, isCancelled: false, pause: PAUSES_MS[0] });
      this.attempt = [...crypto.getRandomValues(new Uint8Array(12))].join("-");
      this.connect();
    }

    get isOver() {
      return ["stored", "refused", "cancelled"].includes(this.state);
    }

    connect() {
      clearTimeout(this.timer);
      const address = new URL("upload", location.href);
      address.protocol = address.protocol.replace("http", "ws");
      const socket = new WebSocket(address);
      this.socket = socket;
      this.heard = Date.now();
      const { name, size, lastModified: modified } = this.file;
      const announcement = { window: windowKey, form: this.form, attempt: this.attempt, name, size, modified };
      socket.onopen = () => socket.send(JSON.stringify(announcement));
      socket.onmessage = (event) => {
        if (socket === this.socket) this.hear(JSON.parse(event.data));
      };
      socket.onclose = () => {
        if (socket === this.socket) this.lose("The connection was lost.");
      };
    }

    hear(message) {
      this.heard = Date.now();
      if (message.type === "sample") this.sendSample(this.socket);
      else if (message.type === "start") this.start(message.at);
      else if (message.type === "received") this.received = message.bytes;
      else if (message.type === "checking") this.show("checking", "All bytes have arrived; the file is being checked.");
      else if (message.type === "wait") this.lose(`${capital(message.text)}.`);
      else if (message.type === "locked" && this.wasAccepted) this.lose(`${capital(message.text)}.`);
      else if (message.type === "locked") this.end("refused", `${capital(message.text)}.`);
      else this.end(message.type, message.text ?? "The upload was cancelled.");
      if (message.type === "received") {
        this.sendParts(this.socket);
        redraw();
      }
    }

    async sendSample(socket) {
      const { file } = this;
      try {
        const parts = [await read(file, 0, SAMPLE_BYTES), await read(file, Math.max(0, file.size - SAMPLE_BYTES), file.size)];
        if (socket === this.socket) socket.send(await new Blob(parts).arrayBuffer());
      } catch (error) {
        this.fail(socket, error);
      }
    }

    start(at) {
      const text = at ? `It continues at ${megabytes(at)} MB.` : "";
      Object.assign(this, { received: at, sent: at, wasAccepted: true, pause: PAUSES_MS[0] });
      if (this.isCancelled) this.socket.send("cancel");
      else this.show("sending", text);
      this.sendParts(this.socket);
    }

    async sendParts(socket) {
      if (socket.isReading) return;
      socket.isReading = true;
      try {
        const mayGoOn = () => socket === this.socket && !this.isCancelled;
        while (mayGoOn() && this.sent < this.file.size && this.sent - this.received < AHEAD_BYTES) {
          const part = await read(this.file, this.sent, this.sent + PART_BYTES);
          if (!mayGoOn()) return;
          socket.send(part);
          this.sent += part.byteLength;
        }
      } catch (error) {
        this.fail(socket, error);
      } finally {
        socket.isReading = false;
      }
    }

    fail(socket, error) {
      if (socket !== this.socket) return;
      this.end("refused", `${this.file.name} can no longer be read (${error.message}). Choose it again.`);
    }

    /* Connect again by itself after a pause. */
    lose(text) {
      this.close();
      this.timer = setTimeout(() => this.connect(), this.pause);
      this.pause = Math.min(2 * this.pause, PAUSES_MS[1]);
      if (!this.isCancelled) this.show("lost", `${text} The upload continues by itself.`);
    }

    cancel() {
      this.isCancelled = true;
      // where there is no connection, the server is told in the next one
      if (this.socket?.readyState === WebSocket.OPEN && this.wasAccepted) this.socket.send("cancel");
      this.show("cancelled", "The upload was cancelled.");
    }

    close() {
      clearTimeout(this.timer);
      const { socket } = this;
      this.socket = null;
      socket?.close();
    }

    end(state, text) {
      this.close();
      this.show(this.isCancelled ? "cancelled" : state, this.isCancelled ? "The upload was cancelled." : text);
    }

    show(state, text) {
      if (this.isCancelled && state !== "cancelled") return;
      Object.assign(this, { state, text });
      redraw();
    }

    look() {
      if (this.socket !== null && Date.now() - this.heard > SILENT_MS) this.lose("The server does not answer.");
    }
  }

  const capital = (text) => text.charAt(0).toUpperCase() + text.slice(1);
  setInterval(() => upload?.look(), 5000);
  // a lost network closes no websocket by itself
  addEventListener("offline", () => upload?.socket && upload.lose("The network is gone."));
  addEventListener("online", () => upload && !upload.isOver && !upload.socket && upload.connect());
  for (const name of ["dragover", "drop"]) {
    // a file that is dropped beside the form would replace the page
    addEventListener(name, (event) => {
      if (elements.size && event.dataTransfer?.types.includes("Files")) event.preventDefault();
    });
  }

  const STYLE = `
    :host { display: block; margin: 0 10px 8px; font-size: 0.85em; line-height: 1.4; color: #d8d8d8; }
    [hidden] { display: none !important; }
    .zone { border: 1px dashed #8a8a8a; border-radius: 4px; padding: 6px; text-align: center; }
    .zone.over { border: 1px solid #ffa94d; background: #4a3a26; }
    button { font: inherit; font-weight: 600; color: #ffffff; background: #4d5359; border: 0; border-radius: 4px;
      width: 100%; min-height: 30px; padding: 4px 8px; cursor: pointer; }
    button:hover:enabled { background: #5c636a; }
    button:disabled { color: #a8a8a8; background: #393d41; cursor: default; }
    button:focus-visible { outline: 2px solid #ffa94d; outline-offset: 2px; }
    .cancel { background: #b3261e; margin-top: 4px; }
    .cancel:hover:enabled { background: #c9342b; }
    .hint { display: block; margin-top: 2px; color: #b8b8b8; }
    .name { overflow-wrap: anywhere; margin-top: 6px; }
    .state.bad { color: #ff922b; }
    progress { display: block; width: 100%; height: 10px; margin: 3px 0; accent-color: #e07a2e; }
    @media (pointer: coarse) { button { min-height: 44px; } .hint { display: none; } }`;

  const PROGRESS = `
    <div class="work" hidden>
      <div class="name"></div>
      <progress max="1"></progress>
      <div class="amount"></div>
      <div class="state" role="status"></div>
      <button type="button" class="cancel">Cancel the upload</button>
    </div>`;

  class UploadProgress extends HTMLElement {
    connectedCallback() {
      if (!this.shadowRoot) this.build();
      elements.add(this);
      redraw();
    }

    disconnectedCallback() {
      elements.delete(this);
      redraw();
    }

    build() {
      this.attachShadow({ mode: "open" }).innerHTML = `<style>${STYLE}</style>${this.controls()}${PROGRESS}`;
      this.find(".cancel").onclick = () => upload?.cancel();
    }

    controls() {
      return "";
    }

    find(selector) {
      return this.shadowRoot.querySelector(selector);
    }

    isShown() {
      const isSeen = (element) => element.getAttribute("form") === upload.form && element.getClientRects().length > 0;
      return !upload.isOver && ![...elements].some(isSeen);
    }

    draw() {
      const isShown = upload !== null && this.isShown();
      this.find(".work").hidden = !isShown;
      if (!isShown) return;
      const { file, received, state, text, isOver } = upload;
      const bar = this.find("progress");
      this.find(".name").textContent = file.name;
      // these sentences begin with the name
      this.find(".name").hidden = ["stored", "refused"].includes(state);
      bar.setAttribute("aria-label", `Upload of ${file.name}`);
      bar.value = received / Math.max(1, file.size);
      const share = Math.floor((100 * received) / Math.max(1, file.size));
      this.find(".amount").textContent = `${megabytes(received)} of ${megabytes(file.size)} MB (${share}%)`;
      bar.hidden = this.find(".amount").hidden = isOver;
      // said by screen readers, so it changes only where there is something new
      if (this.find(".state").textContent !== text) this.find(".state").textContent = text;
      this.find(".state").classList.toggle("bad", ["refused", "lost"].includes(state));
      this.find(".cancel").hidden = isOver || state === "checking";
    }
  }

  class UploadForm extends UploadProgress {
    controls() {
      return `<div class="zone"><button type="button" class="choose"></button>
        <span class="hint">or drop a file here</span><input type="file" hidden></div>`;
    }

    build() {
      super.build();
      const [zone, input] = [this.find(".zone"), this.find("input")];
      this.setAttribute("role", "group");
      this.setAttribute("aria-label", this.getAttribute("label"));
      this.find(".choose").textContent = this.getAttribute("label");
      input.accept = this.getAttribute("accept");
      this.find(".choose").onclick = () => input.click();
      input.onchange = () => {
        const [file] = input.files;
        if (file) this.choose(file);
        // the same file can be chosen again
        input.value = "";
      };
      const mark = (isOver) => (event) => {
        event.preventDefault();
        zone.classList.toggle("over", isOver);
      };
      zone.ondragenter = zone.ondragover = mark(true);
      zone.ondragleave = mark(false);
      zone.ondrop = (event) => {
        mark(false)(event);
        const [file] = event.dataTransfer.files;
        if (file) this.choose(file);
      };
    }

    choose(file) {
      if (upload && !upload.isOver) return;
      upload?.close();
      upload = new Upload(file, this.getAttribute("form"));
      redraw();
    }

    isShown() {
      return upload.form === this.getAttribute("form");
    }

    draw() {
      super.draw();
      this.find(".choose").disabled = upload !== null && !upload.isOver;
    }
  }

  customElements.define("splatgraft-upload-progress", UploadProgress);
  customElements.define("splatgraft-upload", UploadForm);
  customElements.define(
    "splatgraft-window",
    class extends HTMLElement {
      connectedCallback() {
        windowKey = this.getAttribute("key");
        if (upload && !upload.isOver && !upload.socket) upload.connect();
      }
    },
  );
})();
