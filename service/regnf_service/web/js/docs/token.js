// The access token of this tab, under the name that the other pages use.

const KEY = 'regnf.token';

export const token = {
  get value() {
    return sessionStorage.getItem(KEY) ?? '';
  },
  set value(text) {
    if (text) sessionStorage.setItem(KEY, text);
    else sessionStorage.removeItem(KEY);
  },
};
