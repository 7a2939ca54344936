// Light or dark: what was chosen last, else what the system has. A classic script, so that nothing is drawn before it.
(() => {
  const kept = {
    get: () => { try { return localStorage.getItem("theme"); } catch { return null; } }, // a file may have no storage
    set: (name) => { try { localStorage.setItem("theme", name); } catch { /* it is not kept */ } },
  };
  const system = matchMedia("(prefers-color-scheme: dark)");
  const show = (name) => {
    document.documentElement.dataset.theme = name;
    const button = document.getElementById("theme");
    if (button) button.textContent = name === "dark" ? "Light" : "Dark";
    document.dispatchEvent(new Event("theme"));
  };
  const given = () => show(kept.get() || (system.matches ? "dark" : "light"));
  system.addEventListener("change", given);
  given();
  document.addEventListener("DOMContentLoaded", () => {
    given();
    document.getElementById("theme").addEventListener("click", () => {
      const name = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
      kept.set(name);
      show(name);
    });
    // Modules are not loaded from files, so that nothing else could say it.
    const banner = document.getElementById("banner");
    if (banner && location.protocol === "file:" && !document.getElementById("files")) {
      banner.hidden = false;
      banner.textContent = "▲ A browser does not open this page as a file. Put its folder on a file server, or write the page with --one-file.";
    }
  });
})();
