// Decisions, keys and the list of keys. Names come from the server as text and never become HTML here.
"use strict";
(() => {
  const token = document.querySelector("meta[name=token]").content;
  const message = document.getElementById("message");
  const grasp = document.getElementById("grasp");
  let busy = false;

  function say(text, kind = "bad") {
    message.textContent = text;
    message.className = kind;
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
    element.classList.remove("rejected");
    if (decision) element.classList.add(decision);
    element.dataset.decision = decision;
    element.querySelector(".word.decision").textContent = decision;
  }

  // What is decided in all, and what to do next.
  function count(counts) {
    const numbers = { rejected: counts.rejected, samples: counts.samples };
    for (const [id, number] of Object.entries(numbers)) {
      const element = document.getElementById(id);
      if (element) element.textContent = number.toLocaleString("en");
    }
    for (const element of document.querySelectorAll(".rejectedcount")) element.textContent = counts.rejected.toLocaleString("en");
    document.getElementById("nextstep").hidden = !counts.rejected;
  }

  // The same button again withdraws a decision.
  function decide(element, decision, advance) {
    return act(async () => {
      const now = element.dataset.decision || (element.classList.contains(decision) ? decision : "");
      const wanted = now === decision && !advance ? "" : decision;
      const result = await post("/decide", { label: element.dataset.label, decision: wanted });
      show(element, wanted);
      count(result.counts);
      if (advance) go("next");
    });
  }

  function undo() {
    return act(async () => {
      const result = await post("/undo", {});
      if (result.name === null) return say("Nothing to undo.", "good");
      count(result.counts);
      const card = document.querySelector(`[data-label="${result.label}"]`);
      if (card) show(card, result.decision);
      if (card || result.label === null) return say(`Undone: ${result.name}`, "good");
      location.href = `/grasp/${result.label}${location.search}`;
    });
  }

  function go(id) {
    const link = document.getElementById(id);
    if (link) link.click();
  }

  document.addEventListener("click", (event) => {
    const button = event.target.closest("button");
    if (!button) return;
    const element = button.closest("[data-label]");
    if (button.dataset.decide) decide(element, button.dataset.decide, false);
    else if ("undo" in button.dataset) undo();
    else if ("keys" in button.dataset) list.showModal();
  });

  const list = document.getElementById("keys");
  document.addEventListener("keydown", (event) => {
    if (list.open || (event.shiftKey && event.key.startsWith("Arrow"))) return;
    if (event.ctrlKey || event.altKey || event.metaKey || event.target.closest("input:not([type=checkbox]), select, textarea")) return;
    const decidable = grasp && grasp.querySelector("[data-decide]");
    const keys = {
      ArrowRight: () => go("next"), n: () => go("next"),
      ArrowLeft: () => go("previous"), p: () => go("previous"),
      g: () => go("gallery"), u: () => undo(), "?": () => list.showModal(),
      r: () => decidable && decide(grasp, "rejected", true),
    };
    // With Caps Lock a letter is a capital one.
    const action = keys[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!action) return;
    event.preventDefault();
    action();
  });
})();
