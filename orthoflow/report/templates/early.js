"use strict";
// Before the first paint, so that nothing moves when the page's own script has come: what only a script can use
// is shown, and the contents are folded on narrow screens.
document.documentElement.classList.add("scripted");
document.querySelector(".contents details").open = matchMedia("(min-width: 72rem)").matches;
