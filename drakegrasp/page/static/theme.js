// Light or dark: what was chosen and remembered, else as the system. Runs before the page is drawn.
"use strict";
(() => {
  const system = matchMedia("(prefers-color-scheme: dark)");
  let chosen = "";
  try { chosen = localStorage.getItem("theme") || ""; } catch { /* without storage nothing is remembered */ }

  function apply() {
    document.documentElement.dataset.theme = chosen || (system.matches ? "dark" : "light");
    dispatchEvent(new Event("theme"));
  }

  apply();
  system.addEventListener("change", apply);
  addEventListener("DOMContentLoaded", () => {
    const choice = document.getElementById("theme");
    choice.value = chosen;
    choice.addEventListener("change", () => {
      chosen = choice.value;
      try { localStorage.setItem("theme", chosen); } catch { /* as above */ }
      apply();
    });
  });
})();
