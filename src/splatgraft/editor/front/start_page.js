// Renews the cards that have changed while the page is seen; the one in focus keeps it.
"use strict";

const every = 3000;
const list = document.getElementById("projects");

function renew(text) {
  const found = document.createElement("ul");
  found.innerHTML = text;
  const old = new Map([...list.children].map((card) => [card.dataset.key, card]));
  const cards = [...found.children].map((card) => {
    const before = old.get(card.dataset.key);
    return before && before.outerHTML === card.outerHTML ? before : card;
  });
  if (cards.length === list.children.length && cards.every((card, index) => card === list.children[index])) return;
  const focused = document.activeElement?.closest("li")?.dataset.key;
  list.replaceChildren(...cards);
  if (focused) list.querySelector(`li[data-key="${CSS.escape(focused)}"] a`)?.focus();
  const count = document.querySelector(".count");
  count.textContent = `${cards.length} project${cards.length === 1 ? "" : "s"}`;
}

async function look() {
  try {
    if (!document.hidden) {
      const answer = await fetch("list");
      if (answer.ok) renew(await answer.text());
    }
  } catch {
    // the server is away; the next look may find it again
  }
  setTimeout(look, every);
}

setTimeout(look, 1000);
