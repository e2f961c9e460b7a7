// Filters, order and pages of a gallery that is a file: the server does this otherwise.
"use strict";
(() => {
  const PAGE = 24;
  const list = document.getElementById("cards"), form = document.getElementById("filters");
  const pages = document.getElementById("pages"), count = document.getElementById("count");
  if (!list) return;
  const cards = [...list.children];
  let page = 1, chosen = cards;

  const key = (name) => name.replace(/_(.)/g, (_, c) => c.toUpperCase());
  const number = (card, name) => Number.parseFloat(card.dataset[key(name)]);

  function fits(card, values) {
    for (const [name, value] of values) {
      if (value === "" || value === "any" || name === "sort" || name === "order") continue;
      const range = name.match(/^(min|max)_(.*)$/);
      if (range) {
        const x = number(card, range[2]), limit = Number.parseFloat(value);
        if (Number.isNaN(limit)) continue;
        if (!(range[1] === "min" ? x >= limit : x <= limit)) return false;
      } else if (name === "decision") {
        const decision = card.querySelector(".word.decision").textContent || "open";
        if (decision !== value) return false;
      } else if (name === "split" && value === "samples") {
        if (card.dataset.split === "none") return false;
      } else if (!(name === "hold" ? card.dataset.hold.split(" ") : [card.dataset[key(name)]]).includes(value)) return false;
    }
    return true;
  }

  function show() {
    const last = Math.max(1, Math.ceil(chosen.length / PAGE));
    page = Math.min(Math.max(page, 1), last);
    list.replaceChildren(...chosen.slice((page - 1) * PAGE, page * PAGE));
    count.textContent = chosen.length.toLocaleString("en");
    pages.replaceChildren();
    const button = (text, step) => {
      const element = document.createElement("button");
      element.textContent = text;
      element.disabled = page + step < 1 || page + step > last;
      element.addEventListener("click", () => { page += step; show(); scrollTo(0, 0); });
      return element;
    };
    const place = document.createElement("span");
    place.textContent = `page ${page} of ${last}`;
    pages.append(button("← Previous", -1), place, button("Next →", 1));
  }

  function apply() {
    const values = [...new FormData(form)];
    const sort = form.elements.sort.value, up = form.elements.order.value === "up";
    chosen = cards.filter((card) => fits(card, values));
    const rank = (card) => {
      const x = number(card, sort);
      return Number.isNaN(x) ? Infinity : up ? x : -x;
    };
    chosen.sort((a, b) => rank(a) - rank(b));
    page = 1;
    show();
  }

  form.addEventListener("submit", (event) => { event.preventDefault(); apply(); });
  apply();
})();
