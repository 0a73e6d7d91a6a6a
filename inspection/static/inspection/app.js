// Small behaviours of every page: theme, relative times, dialogs, clickable rows, and the banner for lost contact.

document.addEventListener("click", (event) => {
  const at = event.target.closest("[data-theme-switch], [data-open], [data-close], tr[data-href], [data-print]");
  // an open menu closes when something else is touched
  for (const menu of document.querySelectorAll("details.menu[open]")) {
    if (!menu.contains(event.target)) menu.open = false;
  }
  if (!at) return;
  if (at.matches("[data-theme-switch]")) {
    const next = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
    document.documentElement.dataset.theme = next;
    localStorage.setItem("theme", next);
    document.dispatchEvent(new CustomEvent("theme"));
  } else if (at.matches("[data-open]")) {
    document.getElementById(at.dataset.open).showModal();
  } else if (at.matches("[data-close]")) {
    at.closest("dialog").close();
  } else if (at.matches("[data-print]")) {
    print();
  } else if (!event.target.closest("a, button, input, select, label")) {
    location.href = at.dataset.href;
  }
});

document.addEventListener("keydown", (event) => {
  if (event.key === "Escape") for (const menu of document.querySelectorAll("details.menu[open]")) menu.open = false;
  const typing = event.target.closest?.("input, textarea, select, dialog");
  if (event.key === "/" && !typing) {
    const search = document.querySelector("[data-search]");
    if (search) { event.preventDefault(); search.focus(); }
  }
  if (event.key === "?" && !typing) location.href = document.body.dataset.help;
});

// A field marked so sends its form at once (filters); nothing else on the page depends on it.
document.addEventListener("change", (event) => {
  if (event.target.matches("[data-autosend]")) event.target.form.requestSubmit();
});

function agoWords(moment) {
  let seconds = (Date.now() - moment) / 1000;
  const future = seconds < 0;
  seconds = Math.abs(seconds);
  if (seconds < 45) return future ? "in a moment" : "now";
  for (const [limit, size, unit] of [[3600, 60, "min"], [86400, 3600, "h"], [60 * 86400, 86400, "day"]]) {
    if (seconds < limit) {
      const count = Math.round(seconds / size);
      const words = `${count} ${unit}${unit === "day" && count !== 1 ? "s" : ""}`;
      return future ? `in ${words}` : `${words} ago`;
    }
  }
  return null;
}
setInterval(() => {
  for (const time of document.querySelectorAll("time[data-ago]")) {
    const words = agoWords(new Date(time.dateTime));
    if (words) time.textContent = words;
  }
}, 20000);

// Nobody may trust a frozen screen: say when the server is gone, and take it back when it answers again.
const lost = document.getElementById("lost");
let lostSince = null;
function contactLost() {
  lostSince ??= new Date();
  lost.textContent = `No contact with Edgewatch since ${lostSince.toLocaleTimeString()}. What you see may be out of date.`;
  lost.hidden = false;
}
function contactBack() {
  lostSince = null;
  lost.hidden = true;
}
for (const name of ["htmx:sendError", "htmx:timeout"]) document.addEventListener(name, contactLost);
document.addEventListener("htmx:afterRequest", (event) => {
  if (event.detail.xhr?.status >= 500) contactLost();
  else if (event.detail.successful) contactBack();
});
addEventListener("offline", contactLost);

// A form with a file or a long job is sent once.
document.addEventListener("submit", (event) => {
  const button = event.target.querySelector("[data-once]");
  if (!button) return;
  setTimeout(() => { button.disabled = true; button.textContent = button.dataset.once; });
});
addEventListener("pageshow", (event) => { if (event.persisted) location.reload(); });
