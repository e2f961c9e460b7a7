// Decisions and keys. Names come from the server as text and never become HTML here.
"use strict";
(() => {
  const token = document.querySelector("meta[name=token]").content;
  const message = document.getElementById("message");
  const grasp = document.getElementById("grasp");
  let busy = false;

  function say(text) {
    message.textContent = text;
    message.hidden = !text;
  }

  async function post(path, content) {
    const answer = await fetch(path, {
      method: "POST",
      headers: { "content-type": "application/json", "x-drakegrasp-token": token },
      body: JSON.stringify(content),
    }).catch(() => null);
    if (answer === null) throw new Error("The server does not answer: is drakegrasp inspect still running?");
    const result = await answer.json();
    if (!answer.ok) throw new Error(result.error);
    return result;
  }

  // One request at a time; whatever goes wrong is shown.
  async function act(work) {
    if (busy || !token) return;
    busy = true;
    try {
      say("");
      await work();
    } catch (error) {
      say(error.message);
    } finally {
      busy = false;
    }
  }

  function show(element, decision) {
    element.classList.remove("rejected", "kept");
    if (decision) element.classList.add(decision);
    element.dataset.decision = decision;
    element.querySelector(".word.decision").textContent = decision;
  }

  // The same button again withdraws a decision.
  function decide(element, decision, advance) {
    return act(async () => {
      const now = element.dataset.decision || (element.classList.contains(decision) ? decision : "");
      const wanted = now === decision && !advance ? "" : decision;
      await post("/decide", { label: element.dataset.label, decision: wanted });
      show(element, wanted);
      if (advance) go("next");
    });
  }

  function undo() {
    return act(async () => {
      const result = await post("/undo", {});
      if (result.label === null) return say("Nothing to undo.");
      const card = document.querySelector(`[data-label="${result.label}"]`);
      if (card) return show(card, result.decision);
      location.href = `/grasp/${result.label}${location.search}`;
    });
  }

  function record(button) {
    button.disabled = true;
    button.textContent = "Running…";
    return act(async () => {
      const link = document.getElementById("recording");
      try {
        link.href = (await post("/record", { label: grasp.dataset.label })).url;
        link.hidden = false;
        button.hidden = true;
      } finally {
        button.disabled = false;
        button.textContent = "Run again and record";
      }
    });
  }

  function go(id) {
    const link = document.getElementById(id);
    if (link) location.href = link.href;
  }

  document.addEventListener("click", (event) => {
    const button = event.target.closest("button");
    if (!button) return;
    const element = button.closest("[data-label]");
    if (button.dataset.decide) decide(element, button.dataset.decide, false);
    else if ("undo" in button.dataset) undo();
    else if ("record" in button.dataset) record(button);
  });

  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.altKey || event.metaKey || event.target.closest("input, select, textarea")) return;
    const decidable = grasp && grasp.querySelector("[data-decide]");
    const keys = {
      ArrowRight: () => go("next"), n: () => go("next"),
      ArrowLeft: () => go("previous"), p: () => go("previous"),
      g: () => go("gallery"), u: () => undo(),
      r: () => decidable && decide(grasp, "rejected", true),
      k: () => decidable && decide(grasp, "kept", true),
    };
    const action = keys[event.key];
    if (!action) return;
    event.preventDefault();
    action();
  });

  // Empty fields make a long address; leave them out.
  const form = document.getElementById("filters");
  if (form && token) form.addEventListener("submit", () => {
    for (const field of form.elements) if (field.name && field.value === "") field.disabled = true;
  });
  addEventListener("pageshow", () => {
    if (form) for (const field of form.elements) field.disabled = false;
  });
})();
