// Keeps the page up to date, and shows how much of an upload has been sent. Without it: reload the page.
"use strict";
// what the server sent of each part: what is unfolded or filled in here stays
const sent = new Map(Array.from(document.querySelectorAll("[data-live]"), (part) => [part.id, part.innerHTML]));
const filling = (part) => part.contains(document.activeElement) && document.activeElement.matches("input, select");
async function refresh() {
  try {
    const answer = await fetch("/");
    const fresh = new DOMParser().parseFromString(await answer.text(), "text/html");
    for (const old of document.querySelectorAll("[data-live]")) {
      const now = answer.ok && fresh.getElementById(old.id);
      if (!now || now.innerHTML === sent.get(old.id) || filling(old)) continue;
      old.innerHTML = now.innerHTML;
      sent.set(old.id, now.innerHTML);
    }
    document.getElementById("lost").hidden = answer.ok;
  } catch { document.getElementById("lost").hidden = false; }
  setTimeout(refresh, document.querySelector(".running") ? 1000 : 3000);
}
for (const form of document.querySelectorAll("form.upload")) {
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    const shown = form.querySelector("output"), button = form.querySelector("button"), request = new XMLHttpRequest();
    const end = (words) => { shown.textContent = words; button.disabled = false; };
    request.upload.onprogress = (now) => { shown.textContent = `${Math.floor(100 * now.loaded / now.total)} % sent`; };
    request.onerror = () => end("not sent: the connection broke, nothing was stored; upload it again");
    request.onload = () => {
      const answer = new DOMParser().parseFromString(request.responseText, "text/html");
      end(request.status < 400 ? "stored" : answer.body.querySelector(".alert")?.textContent || request.responseText);
      if (request.status < 400) form.reset();
    };
    request.open("POST", form.action);
    request.send(new FormData(form));
    button.disabled = true;
  });
}
setTimeout(refresh, 1000);
