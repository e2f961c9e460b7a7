// Filters and order of a gallery, which act when they are chosen: the answer of the server replaces
// the cards, and nothing else. The address keeps the state.
"use strict";
(() => {
  const form = document.getElementById("filters");
  if (!form) return;
  const message = document.getElementById("message"), told = document.getElementById("told");

  // What is chosen, without empty fields.
  function chosen() {
    return new URLSearchParams([...new FormData(form)].filter(([, value]) => value.trim() !== ""));
  }

  function fill(params) {
    for (const field of form.elements) {
      if (!field.name) continue;
      field.value = params.get(field.name) ?? field.dataset.default ?? "";
      if (field.tagName === "SELECT" && field.selectedIndex < 0) field.selectedIndex = 0;
    }
  }

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
        told.textContent = found.querySelector(".summary").textContent.replace(/\s+/g, " ");
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

  let last = chosen().toString();
  function act() {
    if (chosen().toString() === last) return;
    last = chosen().toString();
    load(`${form.action}?${last}`, true);
  }
  form.addEventListener("change", act);
  form.addEventListener("submit", (event) => { event.preventDefault(); act(); });
  document.getElementById("reset").addEventListener("click", (event) => {
    event.preventDefault();
    fill(new URLSearchParams());
    act();
  });
  addEventListener("popstate", () => {
    fill(new URLSearchParams(location.search));
    last = chosen().toString();
    load(location.href, false);
  });
})();
