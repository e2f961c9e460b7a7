// Filters, order and pages of a gallery, which act when they are chosen. The server selects; where
// the gallery is a file, this script does. The address keeps the state.
"use strict";
(() => {
  const PAGE = 24, TYPING = 300;
  const form = document.getElementById("filters");
  if (!form) return;
  const message = document.getElementById("message"), told = document.getElementById("told");

  // What is chosen, without empty fields.
  function chosen() {
    return new URLSearchParams([...new FormData(form)].filter(([, value]) => value.trim() !== ""));
  }

  // A range must be of numbers; what is wrong with it is said.
  function isReadable() {
    const wrong = [...form.elements].filter((field) => field.inputMode === "decimal" && Number.isNaN(Number(field.value)));
    message.hidden = !wrong.length;
    message.className = "bad";
    message.textContent = wrong.map((field) => `${field.getAttribute("aria-label")} must be a number, got ${field.value}`).join("; ");
    return !wrong.length;
  }

  function fill(params) {
    for (const field of form.elements) {
      if (!field.name) continue;
      field.value = params.get(field.name) ?? field.dataset.default ?? "";
      if (field.tagName === "SELECT" && field.selectedIndex < 0) field.selectedIndex = 0;
    }
  }

  // Text is complete when nothing was typed for a moment, or at Enter.
  function watch(apply) {
    let timer = 0, last = chosen().toString();
    const act = () => {
      clearTimeout(timer);
      if (!isReadable() || chosen().toString() === last) return;
      last = chosen().toString();
      apply();
    };
    form.addEventListener("input", (event) => {
      clearTimeout(timer);
      timer = setTimeout(act, event.target.tagName === "SELECT" ? 0 : TYPING);
    });
    form.addEventListener("change", act);
    form.addEventListener("submit", (event) => { event.preventDefault(); act(); });
    document.getElementById("reset").addEventListener("click", (event) => {
      event.preventDefault();
      fill(new URLSearchParams());
      act();
    });
    return () => { last = chosen().toString(); };
  }

  function tell(text) {
    told.textContent = text.replace(/\s+/g, " ");
  }

  // With a server: its answer replaces the cards, and nothing else.
  function remote() {
    let running = null;

    async function load(address, keep) {
      if (running) running.abort();
      const mine = running = new AbortController();
      const main = document.querySelector("main");
      main.setAttribute("aria-busy", "true");
      try {
        const answer = await fetch(address, { signal: mine.signal });
        const page = new DOMParser().parseFromString(await answer.text(), "text/html");
        const found = page.querySelector("main");
        message.hidden = answer.ok;
        message.className = "bad";
        if (!answer.ok) message.textContent = found.querySelector(".notice").textContent;
        if (answer.ok) {
          main.replaceWith(document.importNode(found, true));
          tell(found.querySelector(".summary").textContent);
          if (keep) history.pushState(null, "", found.dataset.address);
        }
      } catch (error) {
        if (mine.signal.aborted) return;
        message.hidden = false;
        message.className = "bad";
        message.textContent = "The server does not answer: is drakegrasp inspect still running?";
      }
      main.removeAttribute("aria-busy");
    }

    const seen = watch(() => load(`${form.action}?${chosen()}`, true));
    addEventListener("popstate", () => {
      fill(new URLSearchParams(location.search));
      seen();
      load(location.href, false);
    });
  }

  // Without a server: all cards are here, with their values as attributes. A page that is a file may
  // change what is behind the # of its address.
  function local() {
    const list = document.getElementById("cards"), pages = document.getElementById("pages");
    const count = document.getElementById("count");
    const cards = list ? [...list.children] : [];
    const key = (name) => name.replace(/_(.)/g, (_, c) => c.toUpperCase());
    const number = (card, name) => Number.parseFloat(card.dataset[key(name)]);
    let page = 1, shown = cards;

    function fits(card, values) {
      for (const [name, value] of values) {
        if (value === "any" || name === "sort" || name === "order") continue;
        const range = name.match(/^(min|max)_(.*)$/);
        if (range) {
          const x = number(card, range[2]), limit = Number.parseFloat(value);
          if (Number.isNaN(limit)) continue;
          if (!(range[1] === "min" ? x >= limit : x <= limit)) return false;
        } else {
          // Names may have blanks; the others are words.
          const own = card.dataset[key(name)];
          if (!(name === "object" || name === "class" ? [own] : own.split(" ")).includes(value)) return false;
        }
      }
      return true;
    }

    function turn(text, id, step, last) {
      const button = document.createElement("button");
      button.id = id;
      button.textContent = text;
      button.disabled = page + step < 1 || page + step > last;
      button.addEventListener("click", () => { page += step; show(); keep(); scrollTo(0, 0); });
      return button;
    }

    function show() {
      const last = Math.max(1, Math.ceil(shown.length / PAGE));
      page = Math.min(Math.max(page, 1), last);
      if (list) list.replaceChildren(...shown.slice((page - 1) * PAGE, page * PAGE));
      count.textContent = shown.length.toLocaleString("en");
      const place = document.createElement("span");
      place.textContent = `page ${page} of ${last}`;
      pages.replaceChildren(turn("← Previous", "previous", -1, last), place, turn("Next →", "next", 1, last));
    }

    function select() {
      const values = [...chosen()];
      const sort = form.elements.sort.value, up = form.elements.order.value === "up";
      shown = cards.filter((card) => fits(card, values));
      const rank = (card) => {
        const x = number(card, sort);
        return Number.isNaN(x) ? Infinity : up ? x : -x;
      };
      shown.sort((a, b) => rank(a) - rank(b) || 0);
    }

    function keep() {
      const params = chosen();
      if (page > 1) params.set("page", page);
      history.replaceState(null, "", `#${params}`);
    }

    function restore() {
      const params = new URLSearchParams(location.hash.slice(1));
      if (location.hash) fill(params);
      page = Number.parseInt(params.get("page") || "1", 10);
      seen();
      select();
      show();
    }

    const seen = watch(() => {
      page = 1;
      select();
      show();
      keep();
      tell(document.querySelector(".summary").textContent);
    });
    addEventListener("hashchange", restore);
    restore();
  }

  if ("static" in form.dataset) local();
  else remote();
})();
